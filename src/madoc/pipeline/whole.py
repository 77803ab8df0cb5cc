"""The main job from one call: data, calibration, policies, evaluation, each stage skipped where it is done."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from madoc import data, robots
from madoc.calibration import CALIBRATORS, CalibrationResult
from madoc.data import Disturbance
from madoc.errors import MadocError
from madoc.pipeline.calibration_stage import (
    Calibrated,
    CalibrationOrder,
    calibrate_in,
    calibration_ended,
    read_calibration,
)
from madoc.pipeline.data_stage import Source, load_source, record_named, split_name, stored_robot
from madoc.pipeline.evaluation_stage import evaluate_folder
from madoc.pipeline.folders import ENDED, ended, holds_run, working_folder
from madoc.pipeline.keys import seed_key
from madoc.pipeline.learning_stage import PolicyOrder, learn_in
from madoc.pipeline.methods import hyperparameters, make_method
from madoc.policies import LEARNERS, require_reward
from madoc.runs.files import read_json


@dataclass(frozen=True)
class Plan:
    """What `run_all` is asked.

    Attributes:
        name: `TASK-QUALITY` to record, or a task's name with `data`.
        data: A log to use instead of recording one.
        transitions: Rows recorded, or kept of the log.
        disturbance: What to put into them.
        physics: `legacy` or `modern`; None takes the log's, and `legacy` where nothing says.
        level: Ranges to search: `easy`, `normal` or `hard`.
        parameters: Calibrate only these; empty takes all.
        method: A name in `CALIBRATORS`.
        changes: Hyperparameters of the method that differ from its own.
        learner: A name in `LEARNERS`.
        learner_changes: Hyperparameters of the learner that differ from its own.
        calibration_budget: Simulated control steps for the calibration.
        policy_budget: Simulated control steps for each policy, or updates of a learner that does not simulate.
        episodes: For the evaluation of each policy.
        yardsticks: Learn also at mid-range and at the truth, where the truth is known and it makes a difference.
        seed: Of all randomness.
        truth: The target's values by name; None takes the data's, if it has any.
    """

    name: str
    data: Source | None = None
    transitions: int = 200_000
    disturbance: Disturbance = field(default_factory=Disturbance)
    physics: str | None = None
    level: str = "normal"
    parameters: tuple[str, ...] = ()
    method: str = "madoc"
    changes: Mapping[str, Any] = field(default_factory=dict)
    learner: str = "sac"
    learner_changes: Mapping[str, Any] = field(default_factory=dict)
    calibration_budget: int = 300_000
    policy_budget: int = 300_000
    episodes: int = 20
    yardsticks: bool = True
    seed: int = 0
    truth: Mapping[str, float] | None = None


def run_all(plan: Plan, out: Path, *, resume: bool = False, quiet: bool = True) -> dict[str, Any]:
    """Do the main job, and leave a folder with all of it.

    The folder holds `data.npz`, the run folders `calibration`, `policy-calibrated`, `policy-midrange` and
    `policy-truth`, `evaluation.json` and `summary.json`. Killed at any moment and resumed, the summary is the
    same but for its seconds.

    Returns:
        The summary. Its `status` is `finished`; or that of the stage that was interrupted or diverged, and then
        it has what there was until that stage.

    Raises:
        MadocError: The plan cannot be carried out.
    """
    spec = _spec(plan)
    with working_folder(out, spec, resume=resume, keep="data.npz") as folder:
        if (out / "summary.json").exists():
            return read_json(out / "summary.json")
        _data_stage(plan, out, quiet=quiet)
        result = _calibration_stage(plan, out, quiet=quiet)
        calibrated = read_calibration(out / "calibration")
        summary = _beginning(plan, calibrated)
        if result.status not in ENDED:
            return summary | {"status": result.status, "sentence": f"calibration: {result.sentence}"}
        known = calibrated.truth is not None
        compared = plan.yardsticks and known and LEARNERS[plan.learner].needs_parameters
        for at in ("calibrated", "midrange", "truth") if compared else ("calibrated",):
            policy = _policy_stage(plan, calibrated, at, out / f"policy-{at}", quiet=quiet)
            summary["policies"][at] = policy
            if policy["status"] not in ENDED:
                return summary | {"status": policy["status"], "sentence": f"policy-{at}: {policy['sentence']}"}
        if known:
            summary["evaluation"] = evaluate_folder(
                out, episodes=plan.episodes, seed=plan.seed, quiet=quiet, names=tuple(summary["policies"])
            )
        folder.write_json("summary.json", summary)
        return summary


def _spec(plan: Plan) -> dict[str, Any]:
    """The plan as `spec.json` keeps it, refused here if any stage would refuse it."""
    task_name, quality = split_name(plan.name)
    robot = robots.resolve(task_name, plan.physics)
    require_reward(robot)
    if plan.data is None and not quality:
        raise MadocError(f"expected TASK-QUALITY to record, as {task_name}-medium, or --data FILE to load")
    for what, value in {
        "transition": plan.transitions,
        "control step of budget": plan.calibration_budget,
        "control step of policy budget": plan.policy_budget,
        "episode": plan.episodes,
    }.items():
        if value < 1:
            raise MadocError(f"expected at least 1 {what}, got {value}")
    if plan.disturbance.friction != 1.0:
        raise MadocError("a target of another friction is made by madoc record; pass its file as data")
    seed_key(plan.seed)
    fields = asdict(plan)
    for kind, changes, entries in (("method", "changes", CALIBRATORS), ("learner", "learner_changes", LEARNERS)):
        method = make_method(entries, fields[kind], fields.pop(changes))
        fields[kind] = {"name": fields[kind], "hyperparameters": hyperparameters(method)}
    return {"command": "run"} | fields | stored_robot(robot)


def _data_stage(plan: Plan, out: Path, *, quiet: bool) -> None:
    """Leave `data.npz`."""
    if (out / "data.npz").exists():
        return
    physics = plan.physics or "legacy"
    if plan.data is None:
        dataset = record_named(
            plan.name,
            transitions=plan.transitions,
            physics=physics,
            seed=plan.seed,
            disturbance=plan.disturbance,
            quiet=quiet,
        )
    else:
        source = replace(plan.data, max_transitions=plan.transitions, disturbance=plan.disturbance)
        dataset = load_source(source, robots.resolve(split_name(plan.name)[0], plan.physics), seed=plan.seed)
    data.save(dataset, out / "data.npz")


def _calibration_stage(plan: Plan, out: Path, *, quiet: bool) -> CalibrationResult:
    """Leave `calibration`."""
    folder = out / "calibration"
    if calibration_ended(folder) and ended(folder):
        return CalibrationResult.from_json(read_json(folder / "result.json"))
    order = CalibrationOrder(
        task=split_name(plan.name)[0],
        source=Source((str(out / "data.npz"),), max_transitions=None),
        physics=plan.physics,
        level=plan.level,
        parameters=plan.parameters,
        method=plan.method,
        changes=plan.changes,
        budget=plan.calibration_budget,
        seed=plan.seed,
        truth=plan.truth,
    )
    return calibrate_in(folder, order, resume=holds_run(folder), quiet=quiet)


def _policy_stage(plan: Plan, calibrated: Calibrated, at: str, folder: Path, *, quiet: bool) -> dict[str, Any]:
    """Leave the folder of one policy; how its learning ended."""
    if not ended(folder, "policy.npz"):
        order = PolicyOrder(at, plan.learner, plan.learner_changes, plan.policy_budget, plan.seed)
        learn_in(folder, calibrated, order, resume=holds_run(folder), quiet=quiet)
    return read_json(folder / "result.json")


def _beginning(plan: Plan, calibrated: Calibrated) -> dict[str, Any]:
    """The summary of a run whose calibration is there."""
    spec = read_json(calibrated.folder / "spec.json")
    return {
        "name": plan.name,
        "status": "finished",
        "sentence": "all stages are done"
        if calibrated.truth is not None
        else "all stages are done that need no truth: the target is not known, so nothing was evaluated in it",
        "task": calibrated.task.name,
        "physics": calibrated.task.physics,
        "seed": plan.seed,
        "data": {"transitions": spec["data"]["rows"], "fingerprint": spec["data"]["fingerprint"]},
        "calibration": calibrated.result.to_json(),
        "policies": {},
        "evaluation": None,
    }
