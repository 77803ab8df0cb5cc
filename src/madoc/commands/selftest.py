"""`madoc selftest`."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

from rich.table import Table
from tyro.conf import OmitArgPrefixes, arg

from madoc.commands.answer import Answer, Output
from madoc.pipeline.orders import Permission, SelftestOrder

if TYPE_CHECKING:
    from madoc.verdict.selftest import Selftest as Outcome


@dataclass(frozen=True)
class Selftest:
    """Show whether this data could find a truth: plant some in the model, replay the log's actions, calibrate.

    The exit code is 0 only if every parameter came back.
    """

    order: Annotated[SelftestOrder, arg(name="")]
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Plant truths, calibrate, and compare."""
        from madoc.pipeline import selftest_of

        outcome = selftest_of(self.order, quiet=self.output.quiet, permission=self.permission)
        status = "finished" if outcome.passed else "NOT_RECOVERABLE"
        return Answer(outcome.to_json(), (outcome.sentence, _table(outcome, self.order.task)), status)


def _table(outcome: "Outcome", task: str) -> Table:
    """One row for each parameter and planted truth."""
    table = Table(title=f"{outcome.method} on {task}, planted truths", title_justify="left")
    for heading in ("parameter", "unit"):
        table.add_column(heading)
    for heading in ("truth", "planted", "found", "95 %", "covered", "off, % of range"):
        table.add_column(heading, justify="right")
    for row in outcome.rows:
        interval = "" if row.interval is None else f"[{row.interval[0]:.4g}, {row.interval[1]:.4g}]"
        covered = "" if row.covered is None else ("yes" if row.covered else "no")
        table.add_row(
            row.name,
            row.unit,
            str(row.truth),
            f"{row.planted:.4g}",
            f"{row.found:.4g}",
            interval,
            covered,
            f"{row.percent_of_range:.2g}",
        )
    return table
