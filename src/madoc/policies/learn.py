"""Every policy learner by the name that `madoc methods` lists, a run of one, and policies as files.

A file is an npz of plain arrays, readable without JAX by `madoc.numpy_policy`.
"""

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from madoc.errors import MadocError
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.numpy_policy import NumpyPolicy
from madoc.policies.base import PolicyLearner, PolicyProblem, require_reward
from madoc.policies.bc import BC
from madoc.policies.cql import CQL
from madoc.policies.fast_sac import FastSAC
from madoc.policies.h2o import H2O
from madoc.policies.morec import MOREC
from madoc.policies.sac import SAC
from madoc.runs import loop
from madoc.runs.budget import Budget
from madoc.runs.files import replacing
from madoc.runs.run_folder import RunFolder
from madoc.types import MethodEntry, Policy, State, Unit, entry_of

CLONING = {"cloning": 2.5}
"""SAC+BC's weight of SAC's loss beside the cloning error: TD3+BC's."""

_SHOWN = ("return_in_simulator", "temperature")
_sac = partial(MethodEntry[PolicyLearner[Any]], shown=_SHOWN)
_fast = partial(_sac, usual_budget=2_400_000)
_offline = partial(MethodEntry[PolicyLearner[Any]], unit="updates", simulates=False, needs_parameters=False)
_BOX, _BOXED = {"randomize": True}, "Tobin et al., randomization"
_OF_CQL = ("conservative_gap", "value_target", "temperature")
_OF_MOREC = ("model_error", "net_reward", "value_target")
_OF_H2O = ("return_in_simulator", "dynamics_ratio", "value_target")

_ENTRIES: tuple[MethodEntry[PolicyLearner[Any]], ...] = (
    _sac("sac", SAC, "SAC in the calibrated simulator", "Haarnoja et al., SAC", 2018, needs_data=False),
    _fast("fast-sac", FastSAC, "SAC for cheap simulation", "Li et al., PQL", 2023, needs_data=False),
    _fast("rlpd", FastSAC, "fast-sac, half of each batch logged", "Ball et al., RLPD", 2023, {"logged_share": 0.5}),
    _sac("sac-bc", SAC, "SAC, cloning the data's actions too", "Jiang et al., Madoc", 2024, CLONING),
    _sac("dr", SAC, "SAC over the whole box", _BOXED, 2017, _BOX, needs_data=False, needs_parameters=False),
    _sac(
        "dr-bc",
        SAC,
        "SAC over the whole box, cloning the data",
        _BOXED,
        2017,
        {**CLONING, **_BOX},
        needs_parameters=False,
    ),
    _offline("bc", BC, "clones the data's policy", "Pomerleau, ALVINN", 1988, shown=("cloning_loss",)),
    _offline("cql", CQL, "conservative values, from the data alone", "Kumar et al., CQL", 2020, shown=_OF_CQL),
    _offline("morec", MOREC, "a learnt model, kept to what looks real", "Luo et al., MOREC", 2024, shown=_OF_MOREC),
    _sac("h2o", H2O, "SAC on logged and trusted simulated rows", "Niu et al., H2O", 2022, shown=_OF_H2O),
)

LEARNERS: dict[str, MethodEntry[PolicyLearner[Any]]] = {entry.name: entry for entry in _ENTRIES}


@dataclass(frozen=True)
class LearnedPolicy:
    """A policy, and how its learning ended: see `madoc.runs.loop.Finished`; `spent` is counted in `unit`."""

    policy: Policy
    status: str
    sentence: str
    control_steps: int
    updates: int
    spent: int
    unit: Unit
    seconds: float


def learn_policy(
    method: PolicyLearner[State],
    problem: PolicyProblem,
    *,
    key: PRNGKeyArray,
    budget: Budget | str,
    folder: RunFolder | None = None,
    resume: bool = False,
    quiet: bool = False,
    checkpoint_every: float = 60.0,
) -> LearnedPolicy:
    """Learn until the budget is spent.

    The budget counts simulated control steps for a learner that simulates and gradient updates for one that does not;
    its entry in `LEARNERS` says which. At one update per control step, the number of updates is the same for both.
    Or it is a time: `Seconds(300)`, or `300s` or `5min` as text.

    With a folder, the policy is saved there as `policy.npz`, which `madoc.numpy_policy` reads without JAX.

    Raises:
        MadocError: The robot has no reward, the method refuses the problem, or `loop.run` refuses.
    """
    require_reward(problem.simulator.task)
    entry = entry_of(method, LEARNERS)
    finished = loop.run(
        method,
        problem,
        key=key,
        budget=budget,
        folder=folder,
        resume=resume,
        quiet=quiet,
        description=f"{entry.name} on {problem.simulator.task.name}",
        shown=entry.shown,
        checkpoint_every=checkpoint_every,
        unit=entry.unit,
    )
    policy = method.policy(finished.state)
    if folder is not None:
        save_policy(policy, folder.policy, task_name=problem.simulator.task.name)
    seconds = round(finished.seconds, 3)
    counts = finished.control_steps, finished.updates, finished.spent, entry.unit, seconds
    return LearnedPolicy(policy, finished.status, finished.sentence, *counts)


def save_policy(policy: TanhGaussianPolicy, path: str | Path, *, task_name: str) -> None:
    """Write a policy as float32 arrays, with matrices of shape (inputs, outputs), whole or not at all."""
    layers = policy.network.layers
    arrays: dict[str, np.ndarray] = {"about": np.array(json.dumps({"task": task_name, "layers": len(layers)}))}
    for index, layer in enumerate(layers):
        arrays[f"weight_{index}"] = np.asarray(layer.weight.T)
        arrays[f"bias_{index}"] = np.asarray(layer.bias)
    arrays |= {"offset": np.asarray(policy.offset), "scale": np.asarray(policy.scale)}
    with replacing(Path(path)) as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def load_policy(path: str | Path) -> TanhGaussianPolicy:
    """Read a policy.

    Raises:
        MadocError: The file is missing or is not a policy that Madoc saved.
    """
    try:
        return policy_of(NumpyPolicy.load(path))
    except ValueError as error:
        raise MadocError(str(error)) from error


def policy_of(saved: NumpyPolicy) -> TanhGaussianPolicy:
    """A JAX policy with the weights of a saved one."""
    sizes = [weight.shape[1] for weight in saved.weights]
    policy = TanhGaussianPolicy(len(saved.offset), sizes[-1] // 2, tuple(sizes[:-1]), key=jax.random.key(0))
    layers = [
        eqx.tree_at(
            lambda linear: (linear.weight, linear.bias),
            layer,
            (jnp.asarray(weight.T, jnp.float32), jnp.asarray(bias, jnp.float32)),
        )
        for layer, weight, bias in zip(policy.network.layers, saved.weights, saved.biases, strict=True)
    ]
    return eqx.tree_at(
        lambda parts: (parts.network.layers, parts.offset, parts.scale),
        policy,
        (layers, jnp.asarray(saved.offset, jnp.float32), jnp.asarray(saved.scale, jnp.float32)),
    )
