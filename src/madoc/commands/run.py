"""`madoc run`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import RenderableType
from tyro.conf import OmitArgPrefixes, arg

from madoc.commands.answer import Answer, Output, calibration_status, calibration_text, evaluation_text, page_line
from madoc.pipeline.orders import Permission, RunOrder

if TYPE_CHECKING:
    from madoc.report.records import Summary


@dataclass(frozen=True)
class Run:
    """Do all of it: record or load, calibrate and judge, learn, evaluate, and export.

    Leaves a folder with the data, the calibration, the policies, evaluation.json, the exported model, report.html and
    summary.json. Killed at any moment, --resume goes on to the same result. The exit code is the verdict's, as that of
    madoc calibrate.
    """

    order: Annotated[RunOrder, arg(name="")]
    out: Path | None = None
    """Folder. Default: runs/NAME, of a robot of your own without the .yaml."""
    resume: bool = False
    """Go on with the run in the folder."""
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Do all stages, and leave the folder."""
        from madoc.calibration import CalibrationResult
        from madoc.pipeline import leave_motion, run_all
        from madoc.report import leave_report
        from madoc.robots import is_spec_path

        out = self.out or Path("runs") / (
            Path(self.order.name).stem if is_spec_path(self.order.name) else self.order.name
        )
        summary = run_all(self.order, out, resume=self.resume, quiet=self.output.quiet, permission=self.permission)
        result = CalibrationResult.from_json(summary.calibration)
        leave_motion(out, permission=self.permission)
        lines = (*calibration_text(result), *_rest(summary, out), *page_line(leave_report(out)))
        status = calibration_status(result) if summary.status == "finished" else summary.status
        return Answer(summary.to_json() | {"folder": str(out)}, lines, status)


def _rest(summary: "Summary", out: Path) -> tuple[RenderableType, ...]:
    """The stages after the calibration, and where all files are."""
    evaluation = () if summary.evaluation is None else evaluation_text(summary.evaluation)
    files = [f"estimate: {out / 'calibration' / 'result.json'}"]
    files += [f"policy {at}: {out / f'policy-{at}' / 'policy.npz'}" for at in summary.policies]
    if summary.status == "finished":
        files.append(f"summary: {out / 'summary.json'}")
    elif summary.status == "interrupted":
        files.append("go on with the same command and --resume")
    return (*evaluation, f"{summary.status}: {summary.sentence}", *files)
