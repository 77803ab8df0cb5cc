"""Evaluation as a stage: learnt policies in the target, at the estimate, and over the estimate's distribution."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc import simulation
from madoc.errors import MadocError
from madoc.evaluation import evaluate
from madoc.pipeline.calibrated import Calibrated, read_calibration
from madoc.pipeline.data_stage import Machine
from madoc.pipeline.film_stage import leave_film
from madoc.pipeline.orders import NO_PERMISSION, EvaluationOrder, Permission
from madoc.pipeline.refusals import check_counts, stage_key, truth_of
from madoc.policies import ErrorCost, OverDraws, costs_of_errors, load_policy, over_draws
from madoc.report.records import EvaluationRecord, SpecRecord, read_spec
from madoc.runs.files import write_json
from madoc.runs.progress import bar
from madoc.simulation import Simulator
from madoc.types import Policy, named_key

YARDSTICKS = ("midrange", "truth")
"""Where policies are learnt that nobody would deploy: what errors cost them is of no interest."""


def evaluate_folder(
    folder: Path,
    order: EvaluationOrder | None = None,
    *,
    names: Sequence[str] = (),
    calibration: Path | None = None,
    out: Path | None = None,
    quiet: bool = False,
    permission: Permission = NO_PERMISSION,
) -> EvaluationRecord:
    """Evaluate policies of a run on the same starts, and leave `evaluation.json` and `film.npz` there, or in `out`.

    The folder is that of a run or of one policy. Without `names` all its policies are evaluated. They act in the target
    where its parameters are known, from the order or from the run; and where the folder holds a calibration, or its
    folder is given, at its estimate, in systems drawn from its distribution, and under an error of each parameter.

    Raises:
        MadocError: There is no policy, neither truth nor calibration is known, or a number is out of range.
    """
    order = order or EvaluationOrder()
    check_counts(episode=order.episodes, draw=order.draws)
    key = stage_key(order.seed, "evaluating")
    found = find_policies(folder)
    policies = {name: load_policy(found[name]) for name in names or found}
    spec = _spec_with_truth(folder, found)
    machine = Machine.restored(spec, permission=permission)
    truth = truth_of(order.truth, machine.task, spec.parameters, known=spec.truth)
    calibrated = _calibration_of(calibration or folder, permission=permission)
    if truth is None and calibrated is None:
        raise MadocError(
            f"the true parameters of {folder} are not known, and it holds no calibration to evaluate at; "
            "pass --truth FILE.json, or name the run folder"
        )
    target = None if truth is None else machine.at(truth)
    estimated = None
    if calibrated is not None:
        estimated = simulation.make(calibrated.task.for_policies), calibrated.result.mean
    in_target, at_estimate = (
        {} if system is None else _returns(policies, *system, key, order.episodes, where, quiet=quiet)
        for system, where in ((target, "the target"), (estimated, "the estimate"))
    )
    system = target or estimated
    assert system is not None  # one of them is known
    leave_film(out or folder, policies, *system, key)
    yardsticks = [name for name in policies if read_spec(found[name].parent).at in YARDSTICKS]
    evaluation = EvaluationRecord(
        machine.task.name,
        machine.task.physics,
        order.episodes,
        order.seed,
        in_target,
        at_estimate,
        *({}, {}) if calibrated is None else _where_not_sure(policies, yardsticks, calibrated, key, order, quiet=quiet),
        _percent_of_truth(in_target),
    )
    write_json((out or folder) / "evaluation.json", evaluation.to_json())
    return evaluation


def _returns(
    policies: Mapping[str, Policy],
    simulator: Simulator,
    parameters: Float[np.ndarray, " parameters"],
    key: PRNGKeyArray,
    episodes: int,
    where: str,
    *,
    quiet: bool,
) -> dict[str, dict[str, float]]:
    """Returns of policies in one system, from the same starts."""
    task = simulator.task
    total = len(policies) * task.max_episode_steps
    summaries = {}
    with bar(f"evaluating {task.name} at {where}", total=total, unit="steps", quiet=quiet) as advance:
        for name, policy in policies.items():
            returns = evaluate(policy, simulator, parameters, key=key, episodes=episodes, advance=advance)
            summaries[name] = returns.summary()
    return summaries


def _where_not_sure(
    policies: Mapping[str, Policy],
    yardsticks: Collection[str],
    calibrated: Calibrated,
    key: PRNGKeyArray,
    order: EvaluationOrder,
    *,
    quiet: bool,
) -> tuple[dict[str, OverDraws], dict[str, dict[str, ErrorCost]]]:
    """Returns over draws of the estimate, and of all but yardsticks what an error of each parameter costs."""
    simulator = simulation.make(calibrated.task.for_policies)
    of_draws, of_errors = named_key(key, "draws"), named_key(key, "errors")
    drawn, costs = {}, {}
    with bar("evaluating where the estimate is not sure", total=len(policies), unit="policies", quiet=quiet) as advance:
        for name, policy in policies.items():
            distribution = calibrated.distribution()
            drawn[name] = over_draws(policy, simulator, distribution, key=of_draws, draws=order.draws)
            if name not in yardsticks:
                estimate, half_widths = calibrated.result.mean, calibrated.half_widths
                costs[name] = costs_of_errors(
                    policy, simulator, estimate, half_widths, key=of_errors, episodes=order.episodes
                )
            advance(1)
    return drawn, costs


def _calibration_of(folder: Path, *, permission: Permission) -> Calibrated | None:
    """The calibration that a run folder holds, or is; None of the folder of a policy."""
    held = (folder / "calibration" / "spec.json").exists() or read_spec(folder).command == "calibrate"
    return read_calibration(folder, permission=permission) if held else None


def find_policies(folder: Path) -> dict[str, Path]:
    """The policy files of a run by name: `calibrated`, `midrange`, `truth`, ...

    Raises:
        MadocError: There is none.
    """
    folder = folder.expanduser()
    if not folder.is_dir():
        raise MadocError(f"there is no run folder {folder}; check the path")
    files = [folder / "policy.npz", *sorted(folder.glob("policy-*/policy.npz"))]
    policies = {file.parent.resolve().name.removeprefix("policy-"): file for file in files if file.exists()}
    if not policies:
        raise MadocError(f"there is no learnt policy in {folder}; learn one with: madoc learn {folder}")
    return policies


def _spec_with_truth(folder: Path, policies: Mapping[str, Path]) -> SpecRecord:
    """The spec of a run that says robot, physics and parameters; of several, one that knows the truth."""
    places = [folder / "calibration", folder, *(file.parent for file in policies.values())]
    specs = [spec for spec in map(read_spec, places) if spec.command in ("calibrate", "learn")]
    if not specs:
        raise MadocError(f"{folder} holds no run of madoc: there is no spec.json that names its robot")
    return next((spec for spec in specs if spec.truth is not None), specs[0])


def _percent_of_truth(summaries: Mapping[str, Mapping[str, float]]) -> float | None:
    """Return of the policy learnt from the calibration in percent of that learnt at the truth, where both are there."""
    ours = next((name for name in ("calibrated", "distribution") if name in summaries), None)
    if ours is None or "truth" not in summaries or summaries["truth"]["return"] <= 0:
        return None
    return 100.0 * summaries[ours]["return"] / summaries["truth"]["return"]
