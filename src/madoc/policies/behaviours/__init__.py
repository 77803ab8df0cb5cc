"""The behaviour policies that `madoc record` replays: SAC's own ladder in each target, shipped as float16.

`benchmarks/train_behaviours.py` trained them, `benchmarks/select_behaviours.py` picked the rungs. A quality is
one rung or several in equal shares: D4RL's `medium` (a third of expert), `medium-replay` (the way up to it),
`medium-expert` (half and half); NeoRL's `neorl-low`, `neorl-medium`, `neorl-high` (25, 50, 75 % of expert).
"""

import importlib.resources
import json
from collections.abc import Callable
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from madoc.data import Dataset
from madoc.data.record import join, record
from madoc.data.targets import paper_truth
from madoc.errors import MadocError
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.numpy_policy import NumpyPolicy
from madoc.policies.files import policy_of
from madoc.simulation.base import Simulator

QUALITIES = ("medium", "medium-replay", "medium-expert", "neorl-low", "neorl-medium", "neorl-high")


@dataclass(frozen=True)
class Rung:
    """One policy of a ladder, and what it returned in the target while it was trained."""

    policy: TanhGaussianPolicy
    control_steps: int
    mean_return: float


def ladder(task_name: str) -> tuple[list[Rung], dict[str, list[int]]]:
    """All shipped policies of a robot, and which of them make which quality.

    Raises:
        MadocError: Nothing is shipped for that robot.
    """
    file = importlib.resources.files(__package__) / f"{task_name}.npz"
    if not file.is_file():
        raise MadocError(f"no behaviour policies are shipped for {task_name!r}")
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        about = json.loads(str(arrays["about"]))
        layers = range(about["layers"])
        rungs = []
        for index, (steps, mean_return) in enumerate(zip(about["control_steps"], about["returns"], strict=True)):
            weights = tuple(arrays[f"weight_{layer}"][index].astype(np.float32) for layer in layers)
            biases = tuple(arrays[f"bias_{layer}"][index].astype(np.float32) for layer in layers)
            size = weights[0].shape[0]
            saved = NumpyPolicy(task_name, weights, biases, np.zeros(size), np.ones(size))
            rungs.append(Rung(policy_of(saved), steps, mean_return))
    return rungs, about["qualities"]


def record_quality(
    simulator: Simulator,
    quality: str,
    *,
    transitions: int,
    key: PRNGKeyArray,
    advance: Callable[[int], None] = lambda rows: None,
) -> Dataset:
    """Record one of the paper's datasets in the target with the paper's truth.

    Args:
        simulator: The robot.
        quality: One of `QUALITIES`.
        transitions: Rows wanted.
        key: Randomness.
        advance: Told how many rows have come.

    Raises:
        MadocError: The quality is unknown, or nothing is shipped for the robot.
    """
    task = simulator.task
    if quality not in QUALITIES:
        raise MadocError(f"unknown quality {quality!r}; there are: {', '.join(QUALITIES)}")
    rungs, qualities = ladder(task.name)
    chosen = qualities[quality]
    origin = f"madoc record {task.name}-{quality} ({task.physics} physics)"
    counts = np.diff(np.linspace(0, transitions, len(chosen) + 1).astype(int))
    parts = [
        record(
            rungs[index].policy,
            simulator,
            paper_truth(task.name),
            transitions=int(count),
            key=jax.random.fold_in(key, index),
            origin=origin,
            advance=advance,
        )
        for index, count in zip(chosen, counts, strict=True)
        if count
    ]
    return join(parts, origin)
