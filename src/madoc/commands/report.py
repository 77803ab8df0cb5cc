"""`madoc report`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from madoc.commands.answer import Answer, Output
from madoc.errors import MadocError
from madoc.pipeline.orders import Permission


@dataclass(frozen=True)
class Report:
    """Show a run as one HTML page, or several runs side by side.

    The page holds all it needs: it opens without a network, and can be sent as it is.
    """

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN")]
    """Run folders; of several, the page compares them."""
    out: Path | None = None
    """The page. Default: report.html in the run folder; of several runs, comparison.html here."""
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Write the page."""
        from madoc.pipeline import leave_motion
        from madoc.report import write_comparison, write_report

        if not self.runs:
            raise MadocError("expected a run folder to show; name one, as runs/hopper-medium, or several to compare")
        one = len(self.runs) == 1
        if one:
            leave_motion(self.runs[0], permission=self.permission)
        page = write_report(self.runs[0], self.out) if one else write_comparison(self.runs, self.out)
        return Answer({"page": str(page), "runs": [str(run) for run in self.runs]}, (f"report: {page}",))
