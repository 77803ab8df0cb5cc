"""`madoc calibrate`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, arg

from madoc.commands.answer import Answer, Output, calibration_status, calibration_text, page_line
from madoc.errors import MadocError
from madoc.pipeline.orders import CalibrationOrder, Permission


@dataclass(frozen=True)
class Calibrate:
    """Find the parameters under which the simulator moves as the data does.

    Leaves a run folder: result.json, spec.json, metrics.jsonl, TensorBoard events and a checkpoint. With a hold-out
    the exit code is the verdict's: 0 CALIBRATED, 9 USABLE, 10 NO_IMPROVEMENT, 11 NOT_IDENTIFIABLE,
    12 MODEL_MISMATCH, 13 DATA_REJECTED.
    """

    order: Annotated[CalibrationOrder, arg(name="")]
    out: Path | None = None
    """Run folder. Default: runs/TASK-METHOD-SEED."""
    resume: bool = False
    """Go on with the run in the folder."""
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Calibrate, and leave the run folder."""
        from madoc.pipeline import calibrate_in, default_folder, leave_motion, split_name
        from madoc.report import leave_report

        if split_name(self.order.task)[1]:
            raise MadocError(f"expected the name of a robot, got {self.order.task!r}; the data is given with --data")
        out = self.out or default_folder(self.order)
        result = calibrate_in(out, self.order, resume=self.resume, quiet=self.output.quiet, permission=self.permission)
        leave_motion(out, permission=self.permission)
        lines = (*calibration_text(result), f"run folder: {out}", *page_line(leave_report(out)))
        return Answer(result.to_json(), lines, calibration_status(result))
