"""All stages in one call: data, calibration, policies, evaluation, export; a stage that has ended is skipped."""

from dataclasses import asdict, replace
from pathlib import Path

from madoc import data
from madoc.calibration import CalibrationResult
from madoc.errors import MadocError
from madoc.pipeline import refusals
from madoc.pipeline.calibrated import Calibrated, calibration_ended, read_calibration
from madoc.pipeline.calibration_stage import calibrate_in
from madoc.pipeline.data_stage import Machine, load_source, record_named, split_name
from madoc.pipeline.evaluation_stage import evaluate_folder
from madoc.pipeline.export_stage import export_run
from madoc.pipeline.learning_stage import learn_in
from madoc.pipeline.methods import hyperparameters, learner_of, methods_for
from madoc.pipeline.orders import (
    NO_PERMISSION,
    CalibrationOrder,
    Drawing,
    EvaluationOrder,
    Permission,
    Place,
    PolicyOrder,
    RecordOrder,
    RunOrder,
    Source,
)
from madoc.report.records import Summary, read_object, read_record
from madoc.robots import is_spec_path
from madoc.runs.files import read_json
from madoc.runs.run_folder import ENDED, ended, holds_run, working_folder


def run_all(
    order: RunOrder, out: Path, *, resume: bool = False, quiet: bool = False, permission: Permission = NO_PERMISSION
) -> Summary:
    """Do all stages, and leave a folder with their files.

    The folder holds `data.npz`, the run folders `calibration`, `policy-calibrated` (or `policy-distribution`),
    `policy-midrange` and `policy-truth`, `evaluation.json`, `export` and `summary.json`. Killed at any moment and
    resumed, the summary is the same but for its seconds.

    Returns:
        The summary. Its `status` is `finished`, or that of the stage that was interrupted or diverged.

    Raises:
        MadocError: The order cannot be carried out.
    """
    if order.data:
        order = replace(order, data=_source(order).absolute().paths)
    machine = Machine.named(split_name(order.name)[0], order.search.physics, permission=permission)
    spec = _spec(order, machine, out)
    with working_folder(out, spec, resume=resume, keep="data.npz") as folder:
        if (out / "summary.json").exists():
            return read_record(Summary, out / "summary.json")
        if not (out / "data.npz").exists():
            data.save(_recorded_or_loaded(order, machine, quiet=quiet), out / "data.npz")
        result = _calibrate(order, out, quiet=quiet, permission=permission)
        calibrated = read_calibration(out / "calibration", permission=permission)
        summary = _beginning(order, calibrated)
        if result.status not in ENDED:
            return replace(summary, status=result.status, sentence=f"calibration: {result.sentence}")
        truth_known = calibrated.spec.truth is not None
        _, entry = learner_of(order.learner, order.policy_set)
        compared = order.yardsticks and truth_known and entry.needs_parameters
        places: tuple[Place, ...] = (order.policy_at, *(("midrange", "truth") if compared else ()))
        for at in places:
            policy = _learn(order, calibrated, at, out / f"policy-{at}", quiet=quiet)
            summary = replace(summary, policies={**summary.policies, at: policy})
            if policy["status"] not in ENDED:
                return replace(summary, status=str(policy["status"]), sentence=f"policy-{at}: {policy['sentence']}")
        asked = EvaluationOrder(order.episodes, order.draws, order.search.seed)
        evaluation = evaluate_folder(out, asked, names=places, quiet=quiet, permission=permission)
        summary = replace(summary, evaluation=evaluation)
        export_run(out, permission=permission)
        folder.write_json("summary.json", summary.to_json())
        return summary


def _source(order: RunOrder) -> Source:
    """The log of an order that names one."""
    return Source(order.data, order.transitions, order.reading)


def _calibration_order(order: RunOrder, source: Source) -> CalibrationOrder:
    """The calibration that a run asks for."""
    task = split_name(order.name)[0]
    return CalibrationOrder(task, source, order.search, holdout=order.holdout, truth=order.truth)


def _policy_order(order: RunOrder) -> PolicyOrder:
    """The policy that a run asks for, yardsticks aside."""
    return PolicyOrder(
        order.learner, order.policy_at, order.drawing, order.policy_set, order.policy_budget, order.search.seed
    )


def _spec(order: RunOrder, machine: Machine, out: Path) -> dict[str, object]:
    """The order as JSON for `spec.json`; it is refused here already if a later stage would refuse it."""
    refusals.check_policy(_policy_order(order), machine.task, written="--policy-{}")
    if not order.data and not split_name(order.name)[1]:
        own = is_spec_path(order.name)
        raise MadocError(
            f"expected logs of {order.name} after --data, as --data logs/"
            if own
            else f"expected TASK-QUALITY to record, as {order.name}-medium, or --data FILE to load"
        )
    refusals.check_counts(transition=order.transitions, episode=order.episodes, draw=order.draws)
    asked = _calibration_order(order, Source(order.data or (order.name,), order.transitions, order.reading))
    refusals.check_folder(out, asked.source)
    refusals.check_calibration(asked, machine.task)
    methods = methods_for(asked.method, order.search.set)
    learner, entry = learner_of(order.learner, order.policy_set)
    refusals.require_velocities(entry, order.reading.disturbance, f"the data of {order.name}")
    resolved = {
        "command": "run",
        "truth": refusals.truth_of(order.truth, machine.task, order.search.parameters),
        "hyperparameters": {name: hyperparameters(method) for name, method in methods.items()},
        "policy_hyperparameters": hyperparameters(learner),
    }
    plain = replace(order, search=replace(order.search, set=()), policy_set=())
    return asdict(plain) | resolved | machine.stored()


def _recorded_or_loaded(order: RunOrder, machine: Machine, *, quiet: bool) -> data.Dataset:
    """The data of the run."""
    seed, disturbance = order.search.seed, order.reading.disturbance
    if order.data:
        return load_source(_source(order), machine, seed=seed)
    physics = order.search.physics or "legacy"
    asked = RecordOrder(order.name, order.transitions, seed, physics, disturbance.friction, disturbance)
    return record_named(asked, quiet=quiet)


def _calibrate(order: RunOrder, out: Path, *, quiet: bool, permission: Permission) -> CalibrationResult:
    """Leave `calibration`."""
    folder = out / "calibration"
    if calibration_ended(folder) and ended(folder):
        return CalibrationResult.from_json(read_json(folder / "result.json"))
    source = Source((str(out / "data.npz"),), max_transitions=None)
    asked = _calibration_order(order, source)
    return calibrate_in(folder, asked, resume=holds_run(folder), quiet=quiet, permission=permission)


def _learn(order: RunOrder, calibrated: Calibrated, at: Place, folder: Path, *, quiet: bool) -> dict[str, object]:
    """Leave the folder of one policy; returns how its learning ended."""
    if not ended(folder, "policy.npz"):
        asked = _policy_order(order)
        if at != order.policy_at:
            asked = replace(asked, at=at, drawing=Drawing())
        learn_in(folder, calibrated, asked, resume=holds_run(folder), quiet=quiet)
    return read_object(folder / "result.json")


def _beginning(order: RunOrder, calibrated: Calibrated) -> Summary:
    """The summary of a run whose calibration is there."""
    stored = calibrated.spec.data
    assert stored is not None
    known = calibrated.spec.truth is not None
    return Summary(
        name=order.name,
        status="finished",
        sentence="all stages are done"
        if known
        else "all stages are done; the target's parameters are not known, so policies were evaluated at the estimate",
        task=calibrated.task.name,
        physics=calibrated.task.physics,
        seed=order.search.seed,
        data={"transitions": stored.rows, "fingerprint": stored.fingerprint},
        calibration=calibrated.result.to_json(),
    )
