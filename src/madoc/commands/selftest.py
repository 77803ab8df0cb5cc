"""`madoc selftest`."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional, arg

from madoc.commands.answer import Answer, Output
from madoc.commands.calibrate import Settings, changes_of
from madoc.commands.log import Log

if TYPE_CHECKING:
    from madoc.verdict.selftest import Selftest as Outcome


@dataclass(frozen=True)
class Selftest:
    """Show whether this data could find a truth: plant some in the model, replay the log's actions, calibrate.

    The exit code is 0 only if every parameter came back.
    """

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """The robot, as `madoc tasks` lists it, or the spec file of your own, as robot.yaml."""
    log: OmitArgPrefixes[Log]
    method: str = "auto"
    """A calibrator, as `madoc methods` lists it, or auto: the first that the data allows."""
    set: Settings = ()
    """Hyperparameters of the method as name=value; of a method that auto tries as madoc.name=value."""
    truths: int = 3
    """How many truths to plant, one after another."""
    budget: int = 400_000
    """Simulated control steps for each; least squares has as many under auto."""
    seed: int = 0
    """Of all randomness."""
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Plant, calibrate, compare."""
        from madoc.pipeline import selftest_of

        order = self.log.order(
            self.task, method=self.method, changes=changes_of(self.set), budget=self.budget, seed=self.seed
        )
        outcome = selftest_of(order, truths=self.truths, quiet=self.output.quiet)
        status = "finished" if outcome.passed else "NOT_RECOVERABLE"
        return Answer(outcome.to_json(), (outcome.sentence, _table(outcome, self.task)), status)


def _table(outcome: "Outcome", task: str) -> Table:
    """A row a parameter and planted truth."""
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
