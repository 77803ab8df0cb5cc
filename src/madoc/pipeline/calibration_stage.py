"""Calibration as a stage: from an order and a folder to a result, and back from the folder."""

import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from madoc import robots, simulation, tasks
from madoc.calibration import CALIBRATORS, CalibrationProblem, CalibrationResult, calibrate
from madoc.data import Dataset, Disturbance, observed_task
from madoc.errors import MadocError, unknown_name
from madoc.files import read_json
from madoc.parameters import Parameter, ParameterSpace
from madoc.pipeline.check_stage import checked
from madoc.pipeline.data_stage import Source, check_truth, fingerprint, load_source, stored_robot, task_of_spec
from madoc.pipeline.folders import restored_path, stored_path, working_folder
from madoc.pipeline.keys import seed_key
from madoc.pipeline.methods import hyperparameters, make_method
from madoc.tasks import Task


@dataclass(frozen=True)
class CalibrationOrder:
    """What a calibration is asked.

    Attributes:
        task: Name of the robot, or the path of a spec file.
        source: The logged data.
        physics: `legacy` or `modern`; None takes the data's, and `legacy` where the data does not say.
        level: Ranges to search: `easy`, `normal` or `hard`.
        parameters: Calibrate only these; empty takes all.
        method: A name in `CALIBRATORS`.
        changes: Hyperparameters that differ from the method's own.
        budget: Simulated control steps.
        seed: Of all randomness.
        truth: The target's physical values by name, for judging only; None takes the data's, if it has any.
    """

    task: str
    source: Source
    physics: str | None = None
    level: str = "normal"
    parameters: tuple[str, ...] = ()
    method: str = "madoc"
    changes: Mapping[str, Any] = field(default_factory=dict)
    budget: int = 300_000
    seed: int = 0
    truth: Mapping[str, float] | None = None


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
    """Calibrate, and leave a run folder.

    Raises:
        MadocError: The order cannot be carried out; a new folder is then not left behind.
    """
    key = seed_key(order.seed)
    if order.budget < 1:
        raise MadocError(f"expected a budget of at least 1 control step, got {order.budget}")
    method = make_method(CALIBRATORS, order.method, order.changes)
    dataset, task = _prepare(order)
    truth = dataset.true_parameters if order.truth is None else dict(order.truth)
    if truth is not None:
        check_truth(truth, task, physics=task.physics)
    simulator = simulation.make(task)
    if task.source is not None:
        dataset = checked(dataset, simulator)
    problem = CalibrationProblem(dataset, simulator)
    spec = _spec(order, method, task, dataset, truth, out)
    with working_folder(out, spec, resume=resume) as folder:
        return calibrate(
            method,
            problem,
            key=key,
            budget=order.budget,
            truth=None if truth is None else {name: truth[name] for name in task.parameters.names},
            folder=folder,
            resume=resume,
            quiet=quiet,
        )


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
    """Whether the whole result is there; the loop leaves a shorter one a moment before it."""
    file = folder / "result.json"
    return file.exists() and "parameters" in read_json(file)


def _prepare(order: CalibrationOrder) -> tuple[Dataset, Task]:
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
            f"{order.source.path} was recorded in {said} physics and is calibrated in {task.physics}: "
            "the estimate will make up for the difference; leave out --physics to take the data's",
            stacklevel=2,
        )
    return dataset, task.with_parameters(list(order.parameters)) if order.parameters else task


def _spec(
    order: CalibrationOrder,
    method: Any,
    task: Task,
    dataset: Dataset,
    truth: Mapping[str, float] | None,
    out: Path,
) -> dict[str, Any]:
    path = Path(order.source.path).expanduser()
    where = stored_path(path, out) if path.exists() else order.source.path
    return {
        "command": "calibrate",
        "task": task.name,
        "physics": task.physics,
        "level": order.level,
        "parameters": {row.name: [row.low, row.high] for row in task.parameters.parameters},
        "method": order.method,
        "hyperparameters": hyperparameters(method),
        "data": asdict(replace(order.source, path=where)) | {"rows": len(dataset), "fingerprint": fingerprint(dataset)},
        "seed": order.seed,
        "budget": order.budget,
        "truth": truth,
    } | stored_robot(task)


def _source_of(remembered: Mapping[str, Any], folder: Path) -> Source:
    path = remembered["path"]
    if path.startswith(("/", "..")) or (folder / path).exists():
        path = str(restored_path(path, folder))  # else the id of a Minari dataset
    wanted = {name: remembered[name] for name in ("format", "clip_actions", "max_transitions")}
    return Source(path, **wanted, disturbance=Disturbance(**remembered.get("disturbance", {})))


def _space_of(result: CalibrationResult, whole: Task) -> ParameterSpace:
    """Exactly the parameters and ranges of a result."""
    known = {row.name: row for row in whole.parameters.parameters}
    rows = []
    for name, row in result.parameters.items():
        field_name, _, element = name.partition(".")
        named = known.get(name) or Parameter(field_name, element, row.low, row.high)
        rows.append(replace(named, low=row.low, high=row.high))
    return ParameterSpace(tuple(rows))
