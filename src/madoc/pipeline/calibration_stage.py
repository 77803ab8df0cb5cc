"""Calibration as a stage: from an order and a folder to a result, and back from the folder."""

import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from madoc import robots, simulation, tasks
from madoc.calibration import CALIBRATORS, CalibrationProblem, CalibrationResult, Calibrator, calibrate
from madoc.data import Dataset, Disturbance, observed_task
from madoc.data.split import hold_out
from madoc.errors import MadocError, unknown_name
from madoc.parameters import Parameter, ParameterSpace
from madoc.pipeline.check_stage import checked
from madoc.pipeline.data_stage import Source, check_truth, fingerprint, load_source, stored_robot, task_of_spec
from madoc.pipeline.folders import ENDED, restored_path, stored_path, working_folder
from madoc.pipeline.keys import seed_key, stage_key
from madoc.pipeline.methods import hyperparameters, make_method
from madoc.runs.files import read_json
from madoc.simulation import Simulator
from madoc.tasks import Task
from madoc.verdict import Assessment, Bench, assess, judge
from madoc.verdict.evidence import evidence, save_evidence

FEWEST_HELD = 10
"""Rows of which no verdict can be made: perfect predictions of fewer are no surer than chance."""
HOLDOUT = 0.2
"""Share of the rows held out where nothing else is asked: as cross-validation in five folds."""


BUDGET = 300_000
"""Control steps of a calibration, unless told otherwise."""


@dataclass(frozen=True)
class CalibrationOrder:
    """What a calibration is asked.

    Attributes:
        task: Name of the robot, or the path of a spec file.
        source: The logged data.
        physics: `legacy` or `modern`; None takes the data's, and `legacy` where the data does not say.
        level: Ranges to search: `easy`, `normal` or `hard`.
        parameters: Calibrate only these; empty takes all.
        method: A name in `CALIBRATORS`, or `auto` where a stage compares.
        changes: Hyperparameters that differ from the method's own.
        budget: Simulated control steps.
        seed: Of all randomness.
        truth: The target's physical values by name, for judging only; None takes the data's, if it has any.
        holdout: Share of the rows that no method sees, to judge the result by; None judges nothing.
    """

    task: str
    source: Source
    physics: str | None = None
    level: str = "normal"
    parameters: tuple[str, ...] = ()
    method: str = "madoc"
    changes: Mapping[str, Any] = field(default_factory=dict)
    budget: int = BUDGET
    seed: int = 0
    truth: Mapping[str, float] | None = None
    holdout: float | None = None


@dataclass(frozen=True)
class Prepared:
    """What an order comes to.

    Attributes:
        order: What is asked.
        dataset: All rows.
        simulator: Of the robot as the order wants it.
        truth: The target's physical values by name, as the order or the data has them.
    """

    order: CalibrationOrder
    dataset: Dataset
    simulator: Simulator
    truth: dict[str, float] | None

    @cached_property
    def bench(self) -> Bench:
        """What results are judged on."""
        seed, share = self.order.seed, self.order.holdout or HOLDOUT
        split = hold_out(self.dataset, share, stage_key(seed, "hold-out"))
        if len(split.held) < FEWEST_HELD:
            raise MadocError(
                f"expected at least {FEWEST_HELD} rows held out to judge a result by, got {len(split.held)} of "
                f"{len(self.dataset)}; log more, or hold out a larger share with --holdout"
            )
        return Bench(split, self.simulator, stage_key(seed, "verdict"))

    @cached_property
    def problem(self) -> CalibrationProblem:
        """What methods are given: not the rows held out, if any are."""
        return CalibrationProblem(self.dataset, self.simulator) if self.order.holdout is None else self.bench.problem

    @property
    def known(self) -> dict[str, float] | None:
        """The truth of the calibrated parameters."""
        names = self.simulator.parameters.names
        return None if self.truth is None else {name: self.truth[name] for name in names}


@dataclass(frozen=True)
class Calibrated:
    """A calibration read back from its files.

    Attributes:
        task: The robot with the calibrated parameters and their ranges.
        result: The estimate.
        truth: The target's physical values by name, where they are known.
        source: The data, where a run folder remembers it.
        seed: Of the calibration.
        folder: Where the result was found.
    """

    task: Task
    result: CalibrationResult
    truth: dict[str, float] | None
    source: Source | None
    seed: int
    folder: Path


def calibrate_in(out: Path, order: CalibrationOrder, *, resume: bool = False, quiet: bool = True) -> CalibrationResult:
    """Calibrate, judge the result where rows are held out, and leave a run folder.

    Raises:
        MadocError: The order cannot be carried out; a new folder is then not left behind.
    """
    check_order(order)
    check_place(out, order)
    method = make_method(CALIBRATORS, order.method, order.changes)
    return calibrate_prepared(out, order, prepare(order), method, resume=resume, quiet=quiet)[0]


def check_order(order: CalibrationOrder) -> None:
    """Refuse what can be refused without looking at the data.

    Raises:
        MadocError: The seed, the budget or the share held out is impossible.
    """
    seed_key(order.seed)
    if order.budget < 1:
        raise MadocError(f"expected a budget of at least 1 control step, got {order.budget}")
    if order.holdout is not None and not 0.0 < order.holdout < 1.0:
        raise MadocError(f"expected a share of the rows to hold out between 0 and 1, got {order.holdout}")


def check_place(out: Path, order: CalibrationOrder) -> None:
    """Refuse a run folder that holds the logs: a run's files among them would hide them.

    Raises:
        MadocError: Names both.
    """
    folder = out.expanduser().resolve()
    for path in order.source.paths:
        log = Path(path).expanduser().resolve()
        if log == folder or (log.exists() and log.is_relative_to(folder) and not (folder / "spec.json").exists()):
            raise MadocError(f"the run folder {out} holds the log {path}; choose another --out")


def prepare(order: CalibrationOrder) -> Prepared:
    """The data, the robot and the truth of an order."""
    dataset, task = _read(order)
    truth = dataset.true_parameters if order.truth is None else dict(order.truth)
    if truth is not None:
        check_truth(truth, task, physics=task.physics)
    simulator = simulation.make(task)
    if task.source is not None:
        dataset = checked(dataset, simulator)
    return Prepared(order, dataset, simulator, truth)


def calibrate_prepared(
    out: Path,
    order: CalibrationOrder,
    prepared: Prepared,
    method: Calibrator,
    *,
    resume: bool = False,
    quiet: bool = True,
) -> tuple[CalibrationResult, Assessment | None]:
    """Calibrate with a method, judge the result where rows are held out, and leave a run folder.

    Raises:
        MadocError: The method refuses; a new folder is then not left behind.
    """
    problem = prepared.problem
    spec = spec_of(order, prepared, out) | {"hyperparameters": hyperparameters(method)}
    with working_folder(out, spec, resume=resume) as folder:
        result = calibrate(
            method,
            problem,
            key=seed_key(order.seed),
            budget=order.budget,
            truth=prepared.known,
            folder=folder,
            resume=resume,
            quiet=quiet,
        )
        if order.holdout is None or result.status not in ENDED:
            return result, None
        assessment = assess(prepared.bench, result.mean, result.interval)
        result = replace(result, verdict=judge(assessment).to_json(), holdout=assessment.report)
        arrays = evidence(prepared.bench, result.mean, control_step=prepared.simulator.control_step)
        save_evidence(folder.path / "evidence.npz", arrays)
        folder.write_json("result.json", result.to_json())
        return result, assessment


def read_calibration(path: Path, *, physics: str | None = None) -> Calibrated:
    """A finished calibration: a run folder of `madoc calibrate` or `madoc run`, or a bare `result.json`.

    Args:
        path: The folder or file.
        physics: Of the simulator, for a result that lies in no run folder; None is `legacy`.

    Raises:
        MadocError: There is none, or it has not ended.
    """
    folder = path if path.is_dir() else path.parent
    if (folder / "calibration" / "spec.json").exists() and path.is_dir():
        folder = folder / "calibration"
    file = folder / "result.json" if path.is_dir() else path
    spec = read_json(folder / "spec.json") if (folder / "spec.json").exists() else {}
    if path.is_dir() and spec.get("command") == "calibrate" and not calibration_ended(folder):
        raise MadocError(f"the calibration in {folder} has not ended; go on with it with --resume first")
    if not file.exists():
        raise MadocError(f"there is no calibration at {path}; name a run folder or its result.json")
    result = CalibrationResult.from_json(read_json(file))
    said = {"task": result.task, "physics": spec.get("physics") or physics or "legacy"}
    whole = task_of_spec(spec | said)
    task = replace(whole, parameters=_space_of(result, whole))
    remembered = spec.get("data")
    return Calibrated(
        task=task,
        result=result,
        truth=spec.get("truth"),
        source=_source_of(remembered, folder) if remembered else None,
        seed=spec.get("seed", result.seed),
        folder=folder,
    )


def calibration_ended(folder: Path) -> bool:
    """Whether the whole result is there; the loop leaves a shorter one a moment before it, and one without verdict."""
    file = folder / "result.json"
    if not file.exists():
        return False
    result = read_json(file)
    judged = "holdout" not in read_json(folder / "spec.json") or result["status"] not in ENDED or "verdict" in result
    return "parameters" in result and judged


def _read(order: CalibrationOrder) -> tuple[Dataset, Task]:
    """The data, and the robot as the order wants it."""
    reader = robots.resolve(order.task, order.physics)
    for name in order.parameters:
        if name not in reader.parameters.names:
            raise unknown_name(f"parameter of {order.task}", name, reader.parameters.names)
    reader.with_level(order.level)
    dataset = load_source(order.source, reader, seed=order.seed)
    said = dataset.physics if dataset.physics != "unknown" else None
    whole = reader if reader.source is not None else tasks.make(order.task, order.physics or said or "legacy")
    task = whole.with_level(order.level)
    task = observed_task(task, dataset)
    if said is not None and said != task.physics:
        warnings.warn(
            f"{order.source.words} was recorded in {said} physics and is calibrated in {task.physics}: "
            "the estimate will make up for the difference; leave out --physics to take the data's",
            stacklevel=2,
        )
    return dataset, task.with_parameters(list(order.parameters)) if order.parameters else task


def spec_of(order: CalibrationOrder, prepared: Prepared, out: Path) -> dict[str, Any]:
    """An order as `spec.json` keeps it."""
    paths = {path: Path(path).expanduser() for path in order.source.paths}
    where = tuple(stored_path(file, out) if file.exists() else path for path, file in paths.items())
    task, dataset = prepared.simulator.task, prepared.dataset
    held = {} if order.holdout is None else {"holdout": order.holdout}
    return (
        {
            "command": "calibrate",
            "task": task.name,
            "physics": task.physics,
            "level": order.level,
            "parameters": {row.name: [row.low, row.high] for row in task.parameters.parameters},
            "method": order.method,
            "data": asdict(replace(order.source, paths=where))
            | {"rows": len(dataset), "fingerprint": fingerprint(dataset)},
            "seed": order.seed,
            "budget": order.budget,
            "truth": prepared.truth,
        }
        | held
        | stored_robot(task)
    )


def _source_of(remembered: Mapping[str, Any], folder: Path) -> Source:
    paths = []
    for path in remembered["paths"]:
        stored = path.startswith(("/", "..")) or (folder / path).exists()  # else the id of a Minari dataset
        paths.append(str(restored_path(path, folder)) if stored else path)
    wanted = {name: remembered[name] for name in ("format", "clip_actions", "max_transitions")}
    return Source(tuple(paths), **wanted, disturbance=Disturbance(**remembered.get("disturbance", {})))


def _space_of(result: CalibrationResult, whole: Task) -> ParameterSpace:
    """Exactly the parameters and ranges of a result."""
    known = {row.name: row for row in whole.parameters.parameters}
    rows = []
    for name, row in result.parameters.items():
        field_name, _, element = name.partition(".")
        named = known.get(name) or Parameter(field_name, element, row.low, row.high)
        rows.append(replace(named, low=row.low, high=row.high))
    return ParameterSpace(tuple(rows))
