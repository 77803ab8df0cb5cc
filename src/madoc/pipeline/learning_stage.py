"""Policy learning as a stage: in the calibrated simulator, over a distribution of it, or at a yardstick."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from madoc import simulation
from madoc.data import Dataset
from madoc.errors import MadocError, unknown_name
from madoc.parameters import ParameterDistribution
from madoc.pipeline import refusals
from madoc.pipeline.calibrated import Calibrated
from madoc.pipeline.data_stage import fingerprint, load_source
from madoc.pipeline.methods import hyperparameters, learner_of
from madoc.pipeline.orders import DEFAULT_LEARNER, PolicyOrder
from madoc.policies import (
    LEARNERS,
    LearnedPolicy,
    NormalParameters,
    PolicyProblem,
    UniformParameters,
    learn_policy,
)
from madoc.runs.budget import read_budget
from madoc.runs.run_folder import working_folder
from madoc.simulation import Simulator
from madoc.types import MethodEntry


def learn_in(
    out: Path, calibrated: Calibrated, order: PolicyOrder, *, resume: bool = False, quiet: bool = False
) -> LearnedPolicy:
    """Learn a policy, and leave a run folder with `policy.npz`.

    Without a truth in the order, that of the calibration is taken.

    Raises:
        MadocError: The order cannot be carried out; a new folder is then not left behind.
    """
    refusals.check_policy(order, calibrated.task)
    method, entry = learner_of(order.method, order.set)
    budget = read_budget(entry.usual_budget if order.budget is None else order.budget, entry.unit)
    key = refusals.stage_key(order.seed, "learning")
    names = calibrated.task.parameters.names
    truth = refusals.truth_of(order.truth, calibrated.machine.task, names, known=calibrated.spec.truth)
    simulator, parameters = _system(calibrated, order, truth)
    dataset = _logged(calibrated, entry) if entry.needs_data else None
    spec = {
        "command": "learn",
        "task": calibrated.task.name,
        "physics": calibrated.task.physics,
        "at": order.at,
        "drawing": asdict(order.drawing),
        "parameters": _described(simulator, parameters),
        "method": order.method,
        "hyperparameters": hyperparameters(method),
        "seed": order.seed,
        "budget": budget if isinstance(budget, int) else str(budget),
        "truth": truth,
    } | calibrated.machine.stored()
    with working_folder(out, spec, resume=resume) as folder:
        problem = PolicyProblem(simulator, parameters, dataset)
        return learn_policy(method, problem, key=key, budget=budget, folder=folder, resume=resume, quiet=quiet)


def policy_folder_name(at: str, method: str) -> str:
    """`policy-calibrated`, with the method unless that is the default; `policy-cql` where it needs no parameters."""
    if method not in LEARNERS:
        raise unknown_name("method", method, LEARNERS)
    if not LEARNERS[method].needs_parameters:
        return f"policy-{method}"
    return f"policy-{at}" if method == DEFAULT_LEARNER else f"policy-{at}-{method}"


def _logged(calibrated: Calibrated, learner: MethodEntry[Any]) -> Dataset:
    """The data of a calibration, for a learner that learns from it."""
    if calibrated.source is None:
        raise MadocError(
            f"{learner.name} learns from logged data, and a bare result names no data; "
            "give it the run folder of the calibration"
        )
    dataset = load_source(calibrated.source, calibrated.machine, seed=calibrated.result.seed)
    refusals.require_velocities(learner, dataset.disturbance, dataset.origin)
    recorded = "" if calibrated.spec.data is None else calibrated.spec.data.fingerprint
    if recorded and fingerprint(dataset) != recorded:
        raise MadocError(
            f"{dataset.origin} has changed since the calibration in {calibrated.folder}; calibrate anew, or bring the "
            "log back that it was calibrated to"
        )
    return dataset


def _system(
    calibrated: Calibrated, order: PolicyOrder, truth: Mapping[str, float] | None
) -> tuple[Simulator, np.ndarray | ParameterDistribution]:
    """The simulator to learn in, and its physical values, or the distribution to draw them from."""
    at = order.at
    if at == "truth":
        if truth is None:
            raise MadocError("the true parameters are not known here; pass --truth FILE.json")
        return calibrated.machine.at(truth)
    simulator = simulation.make(calibrated.task.for_policies)
    if at == "distribution":
        return simulator, calibrated.distribution(order.drawing)
    if at == "uniform":
        return simulator, UniformParameters(simulator.parameters)
    return simulator, calibrated.result.mean if at == "calibrated" else simulator.parameters.middle


def _described(simulator: Simulator, parameters: np.ndarray | ParameterDistribution) -> dict[str, float]:
    """Parameters by name for spec.json: a value, or the mean (mid-range of a box) of what they are drawn from."""
    if isinstance(parameters, NormalParameters):
        parameters = parameters.mean
    values = parameters if isinstance(parameters, np.ndarray) else simulator.parameters.middle
    return dict(zip(simulator.parameters.names, values.tolist(), strict=True))
