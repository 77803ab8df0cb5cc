"""`madoc suite`, and `madoc worker`, which does its cells."""

import os
import signal
import sys
import threading
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from madoc.commands.answer import Answer, Output
from madoc.errors import MadocError
from madoc.pipeline.orders import Permission

if TYPE_CHECKING:
    from madoc.suites.planning import Plan
    from madoc.suites.standing import Standing


@dataclass(frozen=True)
class Suite:
    """Do many runs: a grid of robots, logs, methods, settings and seeds, described in one file.

    Each cell is a run folder named by the hash of what it asks, so a suite that was stopped goes on, more seeds repeat
    nothing, and a changed setting is another cell. The exit code is 0 if all was done, refusals included.
    """

    file: Annotated[Positional[Path], arg(metavar="SUITE.yaml")]
    """The suite file."""
    out: Path | None = None
    """Folder of the suite; several suites may share one, and then their cells. Default: runs/SUITE."""
    workers: int | None = None
    """How many cells are done at a time; 0 only leaves the plan, for `madoc worker` to do. Default: one for each core;
    of a Ray cluster, as many as it has."""
    executor: Literal["local", "ray"] = "local"
    """local: processes of this machine. ray: those of a Ray cluster; needs the package ray."""
    address: str | None = None
    """With --executor ray: the cluster, as HOST:6379 or auto. Default: one of this machine, for this suite alone."""
    dry_run: bool = False
    """Only list the cells, and forecast how long they take."""
    report: bool = False
    """Only report what has been done: a page and a table of all results."""
    parquet: bool = False
    """With --report: leave the table as Parquet too; needs the package pyarrow."""
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Plan the suite, and do what is left of it."""
        from madoc.runs.machine import usable_cores
        from madoc.suites.planning import plan_of
        from madoc.suites.standing import Standing

        self._check()
        plan = plan_of(self.file, permission=self.permission)
        out = self.out or Path("runs") / plan.name
        workers = usable_cores() if self.workers is None else self.workers
        standing = Standing(out, plan.cells, workers=max(1, workers))
        if self.dry_run:
            return _listed(standing, out, max(1, workers))
        if self.report:
            return self._reported(plan, standing, out)
        return self._done(plan, standing, out, workers)

    def _check(self) -> None:
        """Refuse options that do not go together."""
        if self.workers is not None and self.workers < (0 if self.executor == "local" else 1):
            raise MadocError(f"expected at least 1 worker, or 0 to leave them to madoc worker, got {self.workers}")
        if self.address is not None and self.executor != "ray":
            raise MadocError(f"--address {self.address} names a Ray cluster; add --executor ray")
        if self.address is not None and self.workers is not None:
            raise MadocError(
                "--workers is of a cluster that madoc starts; the one at --address does as many cells as it has CPUs; "
                "leave --workers out"
            )
        if self.dry_run and self.report:
            raise MadocError("--dry-run says what will be done, --report what was done; choose one")
        if self.parquet and not self.report:
            raise MadocError("--parquet is the form of the table of --report; add --report")

    def _done(self, plan: "Plan", standing: "Standing", out: Path, workers: int) -> Answer:
        """Do what is left."""
        from madoc.suites.cells import write_plan
        from madoc.suites.claims import try_again
        from madoc.suites.executors import run_locally, run_on_ray

        write_plan(out, plan.name, plan.cells)
        if any([try_again(cell, out) for cell in plan.cells]):
            standing = type(standing)(out, plan.cells, workers=max(1, workers))
        if workers == 0:
            flag = "".join(f" {word}" for word in self.permission.words)
            lines = (f"{len(standing.runnable):,} cells to do, by: madoc worker {out}{flag}",)
            return Answer({"folder": str(out), "cells": len(plan.cells), "left": len(standing.runnable)}, lines)
        options: dict[str, Any] = {"quiet": self.output.quiet, "permission": self.permission}
        if self.executor == "ray":
            whole = run_on_ray(out, standing, plan=plan.name, workers=self.workers, address=self.address, **options)
        else:
            whole = run_locally(out, standing, plan=plan.name, workers=workers, **options)
        return _told(standing, plan, out, whole=whole, permission=self.permission)

    def _reported(self, plan: "Plan", standing: "Standing", out: Path) -> Answer:
        """Leave the page and the tables."""
        from madoc.suites.report import write_report

        command = f"madoc suite {self.file}" + ("" if self.out is None else f" --out {out}")
        command += "".join(f" {word}" for word in self.permission.words)
        files = write_report(plan, standing, out, command=command, parquet=self.parquet)
        lines = tuple(f"{what}: {file}" for what, file in files.items())
        counts = dict(standing.counts)
        return Answer({"ended": counts, "files": {what: str(file) for what, file in files.items()}}, lines)


def _listed(standing: "Standing", out: Path, workers: int) -> Answer:
    """The cells, a line each, and the forecast."""
    from madoc.suites.standing import lines, rows

    told = standing.forecast()
    listed = rows(standing)
    answer = {
        "folder": str(out),
        "cells": listed,
        "left": told.left,
        "workers": workers,
        "seconds_left": told.seconds,
    }
    return Answer(answer, (*lines(listed), told.sentence(workers)))


def _told(standing: "Standing", plan: "Plan", out: Path, *, whole: bool, permission: Permission) -> Answer:
    """How the suite ended."""
    counts = dict(standing.counts)
    status = "finished" if whole else "interrupted"
    reasons = tuple(
        f"{outcome.status}: {outcome.sentence} ({cell.folder(out)})"
        for cell, outcome in standing.ended.values()
        if not outcome.usable
    )
    shown = reasons[:10] + ((f"and {len(reasons) - 10} more",) if len(reasons) > 10 else ())
    told = ", ".join(f"{count:,} {name}" for name, count in counts.items())
    report = f"report: madoc suite {plan.file} --out {out} --report{''.join(f' {word}' for word in permission.words)}"
    end = report if whole else "go on with the same command"
    lines = (*shown, f"{len(standing.cells):,} cells: {told}", end)
    answer = {"status": status, "folder": str(out), "cells": len(standing.cells), "ended": counts}
    return Answer(answer, lines, "diverged" if whole and "failed" in counts else status)


@dataclass(frozen=True)
class Worker:
    """Do cells of a suite, one after another on one core, until none is left to begin.

    Start it as often as you like, on any machines that share the folder: each cell is done once. A cell whose worker
    was killed is gone on with by the next that comes.
    """

    folder: Annotated[Positional[Path], arg(metavar="SUITE")]
    """The folder of a suite, as `madoc suite` names it."""
    plan: str | None = None
    """Do only the cells of this plan: the name of a suite file, without .yaml. Default: of all in the folder."""
    attached: bool = False
    """Stop when standard input closes, as it does when the process that started this one ends."""
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Claim cells and do them."""
        from madoc.runs.machine import prepare_worker

        if self.attached:
            threading.Thread(target=_stop_at_end_of_input, daemon=True).start()
        prepare_worker()
        from madoc.suites.worker import work  # computes numbers, on the core that was taken

        done = work(self.folder, plan=self.plan, permission=self.permission)
        if done is None:
            return Answer({"status": "interrupted"}, ("interrupted; the next worker goes on",), "interrupted")
        counts = Counter(outcome.status for outcome in done)
        told = ", ".join(f"{count} {status}" for status, count in counts.items()) or "there was nothing to begin"
        return Answer({"ended": dict(counts)}, (f"{len(done)} cells: {told}",))


def _stop_at_end_of_input() -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
