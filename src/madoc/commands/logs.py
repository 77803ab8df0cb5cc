"""`madoc record`, `madoc check` and `madoc selftest`: logs, before anything is calibrated."""

import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.table import Table
from tyro.conf import OmitArgPrefixes, arg

from madoc.commands.answer import Answer, Output, table_of
from madoc.errors import MadocError
from madoc.pipeline.orders import CheckOrder, Permission, RecordOrder, SelftestOrder

if TYPE_CHECKING:
    from madoc.verdict.selftest import Selftest as Outcome


@dataclass(frozen=True)
class Record:
    """Record the paper's data in a target with the paper's truth.

    Behaviour policies that come with madoc act in the target; its true parameters travel with the data.
    """

    order: Annotated[RecordOrder, arg(name="")]
    out: Path | None = None
    """File to write. Default: NAME.npz."""
    force: bool = False
    """Write over an existing file."""
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Record, and write the file."""
        from madoc import data
        from madoc.pipeline import record_named, split_name

        split_name(self.order.name)
        out = (self.out or Path(f"{self.order.name}.npz")).expanduser()
        if out.exists() and not self.force:
            raise MadocError(f"{out} exists already; choose another --out or pass --force to write over it")
        if not out.parent.is_dir():
            raise MadocError(f"no folder {out.parent} to write {out.name} into; make it first")
        started = time.monotonic()
        dataset = record_named(self.order, quiet=self.output.quiet)
        data.save(dataset, out)
        seconds = time.monotonic() - started
        episodes = len(dataset.episode_starts)
        mean_return = float(dataset.transitions.reward.sum()) / episodes
        answer = {
            "path": str(out),
            "name": self.order.name,
            "task": dataset.task_name,
            "physics": dataset.physics,
            "transitions": len(dataset),
            "episodes": episodes,
            "mean_return": mean_return,
            "seed": self.order.seed,
            "seconds": round(seconds, 3),
            "disturbance": asdict(dataset.disturbance),
            "true_parameters": dataset.true_parameters,
        }
        line = f"{len(dataset):,} transitions in {episodes:,} episodes, mean return {mean_return:,.1f}, {seconds:.1f} s"
        return Answer(answer, (line, *dataset.disturbance.sentences(), f"data: {out}"))


@dataclass(frozen=True)
class Check:
    """Say what logs of a robot of your own can and cannot tell, before anything is solved.

    Exit code 2 where a calibration would be refused, 0 otherwise.
    """

    order: Annotated[CheckOrder, arg(name="")]
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Read the logs and check them."""
        from madoc.diagnosis import tables, to_json
        from madoc.pipeline import check_logs

        checked = check_logs(self.order, permission=self.permission)
        status = "rejected" if checked.fatal else "finished"
        if checked.diagnosis is None:
            assert checked.refusal is not None
            answer = {"fatal": True, "findings": [checked.refusal.to_json()]}
            return Answer(answer, (f"fatal: {checked.refusal.sentence}",), status)
        forecasts = [asdict(forecast) for forecast in checked.forecasts]
        lines = tuple(forecast.sentence for forecast in checked.forecasts)
        return Answer(
            to_json(checked.diagnosis, checked.space) | {"forecast": forecasts},
            (*tables(checked.diagnosis, checked.space), *lines),
            status,
        )


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
    numbers = ("truth", "planted", "found", "95 %", "covered", "off, % of range")
    table = table_of(f"{outcome.method} on {task}, planted truths", ("parameter", "unit"), numbers)
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
