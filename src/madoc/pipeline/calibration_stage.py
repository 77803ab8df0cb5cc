"""Calibration as a stage: from an order and a folder to a result, and back from the folder."""

from dataclasses import dataclass, replace
from pathlib import Path

from madoc.calibration import CALIBRATORS, CalibrationResult
from madoc.errors import MadocError
from madoc.parameters import Parameter, ParameterSpace
from madoc.pipeline.auto_stage import calibrate_auto
from madoc.pipeline.data_stage import Machine
from madoc.pipeline.folders import ENDED
from madoc.pipeline.methods import make_method
from madoc.pipeline.one_method import calibrate_prepared
from madoc.pipeline.orders import AUTO, CalibrationOrder, Source
from madoc.pipeline.preparation import check_order, method_of, prepare
from madoc.pipeline.records import SpecRecord, read_spec
from madoc.runs.files import read_json
from madoc.tasks import Task


@dataclass(frozen=True)
class Calibrated:
    """A calibration read back from its files.

    Attributes:
        machine: The robot before any choice of the run.
        task: The robot with the calibrated parameters and their ranges.
        result: The estimate.
        spec: What the run was asked; the defaults for a bare result.
        folder: Where the result was found.
    """

    machine: Machine
    task: Task
    result: CalibrationResult
    spec: SpecRecord
    folder: Path

    @property
    def source(self) -> Source | None:
        """The data, where a run folder remembers it."""
        return None if self.spec.data is None else self.spec.data.source(self.folder)

    @property
    def seed(self) -> int:
        """The seed of the calibration."""
        return self.result.seed if self.spec.seed is None else self.spec.seed


def calibrate_in(
    out: str | Path, order: CalibrationOrder, *, resume: bool = False, quiet: bool = False
) -> CalibrationResult:
    """Calibrate, judge the result where rows are held out, and leave a run folder.

    Raises:
        MadocError: The order cannot be carried out; a new folder is then not left behind.
    """
    out = Path(out)
    check_order(order, out)
    if method_of(order) == AUTO:
        return calibrate_auto(out, prepare(order), resume=resume, quiet=quiet)
    method = make_method(CALIBRATORS, method_of(order), order.search.changes)
    return calibrate_prepared(out, prepare(order), method, resume=resume, quiet=quiet)[0]


def default_folder(order: CalibrationOrder) -> Path:
    """The run folder of an order that names none: `runs/TASK-METHOD-SEED`."""
    return Path("runs") / f"{Path(order.task).stem}-{method_of(order)}-{order.search.seed}"


def read_calibration(path: str | Path, *, physics: str | None = None) -> Calibrated:
    """A finished calibration: a run folder of `madoc calibrate` or `madoc run`, or a bare `result.json`.

    Args:
        path: The folder or file.
        physics: Of the simulator, for a result that lies in no run folder; None is `legacy`.

    Raises:
        MadocError: There is none, or it has not ended.
    """
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    if (folder / "calibration" / "spec.json").exists() and path.is_dir():
        folder = folder / "calibration"
    file = folder / "result.json" if path.is_dir() else path
    spec = read_spec(folder)
    if path.is_dir() and spec.command == "calibrate" and not calibration_ended(folder):
        raise MadocError(f"the calibration in {folder} has not ended; go on with it with --resume first")
    if not file.exists():
        raise MadocError(f"there is no calibration at {path}; name a run folder or its result.json")
    result = CalibrationResult.from_json(read_json(file))
    machine = Machine.restored(replace(spec, task=result.task, physics=spec.physics or physics))
    task = replace(machine.task, parameters=_searched(result, machine.task.parameters))
    return Calibrated(machine, task, result, spec, folder)


def calibration_ended(folder: Path) -> bool:
    """Whether the whole result is there; the loop leaves a shorter one a moment before it, and one without verdict."""
    if not (folder / "result.json").exists():
        return False
    result = read_json(folder / "result.json")
    judged = read_spec(folder).holdout is None or result["status"] not in ENDED or "verdict" in result
    return "parameters" in result and judged


def _searched(result: CalibrationResult, whole: ParameterSpace) -> ParameterSpace:
    """Exactly the parameters and ranges of a result."""
    known = {row.name: row for row in whole.parameters}
    rows = []
    for name, row in result.parameters.items():
        field_name, _, element = name.partition(".")
        named = known.get(name) or Parameter(field_name, element, row.low, row.high)
        rows.append(replace(named, low=row.low, high=row.high))
    return ParameterSpace(tuple(rows))
