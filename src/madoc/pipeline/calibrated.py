"""A finished calibration, read back from its files."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from madoc.calibration import CalibrationResult
from madoc.errors import MadocError
from madoc.identification.information import NORMAL_95
from madoc.parameters import Parameter, ParameterSpace
from madoc.pipeline.data_stage import Machine
from madoc.pipeline.orders import NO_PERMISSION, Drawing, Permission, Reading, Source
from madoc.policies import NormalParameters
from madoc.report.records import SpecRecord, read_spec, restored_path
from madoc.runs.files import read_json
from madoc.runs.run_folder import ENDED
from madoc.tasks import Task


@dataclass(frozen=True)
class Calibrated:
    """A calibration read back from its files.

    Attributes:
        machine: The robot with all of its parameters at their normal ranges.
        task: The robot with the calibrated parameters and their ranges.
        result: The estimate.
        spec: What the run was asked to do; the defaults for a result outside its run folder.
        folder: The folder of the result.
    """

    machine: Machine
    task: Task
    result: CalibrationResult
    spec: SpecRecord
    folder: Path

    @property
    def source(self) -> Source | None:
        """The data, where the run folder names it."""
        data = self.spec.data
        if data is None:
            return None
        reading = Reading(data.format, data.clip_actions, data.disturbance)
        return Source(tuple(restored_path(path, self.folder) for path in data.paths), data.max_transitions, reading)

    def distribution(self, drawing: Drawing | None = None) -> NormalParameters:
        """The joint distribution of the estimate: normal, with the correlations of its covariance.

        The spread of a parameter is the standard deviation that its 95 % interval stands for: the interval is wider
        than the covariance says where the model may lack a term.
        """
        drawing, spread = drawing or Drawing(), self.half_widths / NORMAL_95
        correlation = np.eye(len(spread))
        if self.result.covariance is not None:
            covariance = np.asarray(self.result.covariance)
            deviation = np.sqrt(np.diag(covariance))
            deviation[deviation == 0.0] = 1.0
            correlation = covariance / np.outer(deviation, deviation)
            np.fill_diagonal(correlation, 1.0)
        joint = drawing.width**2 * correlation * np.outer(spread, spread)
        return NormalParameters(self.task.parameters, self.result.mean, joint, drawing.share)

    @property
    def half_widths(self) -> Float[np.ndarray, " parameters"]:
        """Half the width of each parameter's 95 % interval, as `ParameterEstimate.half_width`."""
        return np.array([row.half_width for row in self.result.parameters.values()])


def read_calibration(
    path: str | Path, *, physics: str | None = None, permission: Permission = NO_PERMISSION
) -> Calibrated:
    """A finished calibration: a run folder of `madoc calibrate` or `madoc run`, or a `result.json` alone.

    The physics are those of a result outside its run folder, by default `legacy`. A run whose spec names a Python file
    is refused unless there is permission to run it.

    Raises:
        MadocError: There is no calibration, it has not ended, or it is of other physics.
    """
    path = Path(path).expanduser()
    folder = path if path.is_dir() else path.parent
    if path.is_dir() and (folder / "calibration" / "spec.json").exists():
        folder = folder / "calibration"
    file = folder / "result.json" if path.is_dir() else path
    spec = read_spec(folder)
    if path.is_dir() and spec.command == "calibrate" and not calibration_ended(folder):
        raise MadocError(f"the calibration in {folder} has not ended; go on with it with --resume first")
    if not file.exists():
        raise MadocError(f"there is no calibration at {path}; name a run folder or its result.json")
    if physics is not None and spec.physics and physics != spec.physics:
        raise MadocError(
            f"the calibration in {folder} is of {spec.physics} physics, not {physics}; leave --physics out"
        )
    result = CalibrationResult.from_json(read_json(file))
    machine = Machine.restored(replace(spec, task=result.task, physics=spec.physics or physics), permission=permission)
    task = replace(machine.task, parameters=_calibrated_space(result, machine.task.parameters))
    return Calibrated(machine, task, result, spec, folder)


def calibration_ended(folder: Path) -> bool:
    """Whether the result is complete: the loop leaves one without parameters, and then one without verdict, before."""
    if not (folder / "result.json").exists():
        return False
    result = read_json(folder / "result.json")
    judged = read_spec(folder).holdout is None or result["status"] not in ENDED or "verdict" in result
    return "parameters" in result and judged


def _calibrated_space(result: CalibrationResult, whole: ParameterSpace) -> ParameterSpace:
    """The parameters of a result with their ranges."""
    of_robot = {row.name: row for row in whole.parameters}
    rows = []
    for name, row in result.parameters.items():
        field_name, _, element = name.partition(".")
        parameter = of_robot.get(name) or Parameter(field_name, element, row.low, row.high)
        rows.append(replace(parameter, low=row.low, high=row.high))
    return ParameterSpace(tuple(rows))
