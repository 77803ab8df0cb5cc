"""One loop runs every method, calibrator or policy learner, under a budget of control steps or of updates."""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Generic, Literal

import numpy as np
from jaxtyping import PRNGKeyArray

from madoc.errors import MadocError
from madoc.runs import checkpoint
from madoc.runs.budget import Budget, Seconds, read_budget
from madoc.runs.machine import forget_peak, peak_memory, write_peak
from madoc.runs.progress import Moment, display, interruptible
from madoc.runs.run_folder import RunFolder, RunLog
from madoc.types import Epoch, Method, Metrics, Problem, State, Unit

Status = Literal["finished", "converged", "interrupted", "diverged"]

PREPARATION = 0.1
"""Share of the progress bar for the preparation of a method that has one."""
OVER = 0.1
"""Share of a time budget by which a step may outlast it. One that is expected to take longer is not begun."""


@dataclass(frozen=True)
class Tally:
    """The sums over the epochs of a run, and the stage, share of preparation and convergence of the last one."""

    control_steps: int = 0
    unbudgeted: int = 0
    updates: int = 0
    stage: str = ""
    prepared: float | None = None
    converged: str | None = None

    def plus(self, epoch: Epoch) -> "Tally":
        """The tally after one more epoch."""
        return Tally(
            self.control_steps + epoch.control_steps,
            self.unbudgeted + epoch.unbudgeted,
            self.updates + epoch.updates,
            epoch.stage,
            self.prepared if epoch.fraction is None else epoch.fraction,
            epoch.converged,
        )

    def spent(self, unit: Unit) -> int:
        """The count that is compared with the budget."""
        return self.updates if unit == "updates" else self.control_steps - self.unbudgeted

    def fraction(self, spent_share: float) -> float:
        """Share of all work done, given the share of the budget spent."""
        spent_share = min(spent_share, 1.0)
        return spent_share if self.prepared is None else PREPARATION * self.prepared + (1 - PREPARATION) * spent_share


@dataclass(frozen=True)
class Finished(Generic[State]):
    """How a run ended.

    Attributes:
        state: The last state; of a run that diverged, that of the last checkpoint. Without a folder it is that of the
            time when one was due, and buffers that are written in place are not to be read.
        status: `finished` (the budget is spent, or too little of it is left), `converged`, `interrupted` (by the user)
            or `diverged` (a NaN).
        sentence: The status in words.
        control_steps: Simulated control steps.
        updates: Gradient updates of the result.
        spent: How much of the budget was spent, in its unit; in the method's unit where the budget is a time.
        seconds: Wall-clock time, including that before a resume.
    """

    state: State
    status: Status
    sentence: str
    control_steps: int
    updates: int
    spent: int
    seconds: float


def run(
    method: Method[Problem, State],
    problem: Problem,
    *,
    key: PRNGKeyArray,
    budget: Budget | str,
    folder: RunFolder | None = None,
    resume: bool = False,
    quiet: bool = False,
    description: str = "",
    shown: Sequence[str] = (),
    checkpoint_every: float = 30.0,
    unit: Unit = "control steps",
    trace: Callable[[State], Metrics] | None = None,
) -> Finished[State]:
    """Run a method until its budget is spent, it has converged, the user stops it, or a NaN appears.

    A run killed at any moment and resumed ends with the same bits as one that was not. Ctrl-C (or SIGTERM)
    ends the run after the current step, with a checkpoint; a second one abandons the step.

    Args:
        method: The method.
        problem: The problem that its functions are given.
        key: The only source of randomness; a resumed run needs the same key.
        budget: A count in `unit`, or a time as `Seconds(300)` or "300s"; the step that reaches it is the last, and one
            that would outlast a time by more than `OVER` of it is not begun. A run
            under a time budget that is killed and resumed has the time that was left at the checkpoint, and its result
            depends on the machine's speed.
        folder: The folder for logs, checkpoints and `result.json`; None to write nothing.
        resume: Continue from the folder's checkpoint, or from the start if there is none yet. A run that had ended
            is returned as it is, unless `budget` grew.
        quiet: Show no progress.
        description: Title of the progress bar.
        shown: Metrics to show beside the bar, at most three; if empty, the first three.
        checkpoint_every: Seconds between two checkpoints.
        unit: The unit of the budget.
        trace: A function of the state that gives more finite scalars for the log.

    Raises:
        MadocError: The budget is not positive, there is no folder to resume, the folder holds a run and
            `resume` is false, the checkpoint is damaged or another method's, or the state cannot be saved.
    """
    budget = read_budget(budget, unit)
    _check_folder(folder, resume)
    with ExitStack() as stack:
        interruption = stack.enter_context(interruptible())
        session = _Session(method.init(problem, key), budget, unit, folder, resume, trace)
        if session.ended(interruption.asked) and session.resumed:
            return session.finish()
        session.begin(stack)
        show = stack.enter_context(display(description, unit=unit, quiet=quiet))
        show(session.moment({}))
        due = time.monotonic() + checkpoint_every
        while session.outcome is None:
            try:
                with interruption.breakable():
                    state, epoch = method.step(problem, session.state)
            except KeyboardInterrupt:
                session.abandon()
                break
            metrics = session.take(state, epoch)
            show(session.moment({name: metrics[name] for name in shown if name in metrics} or metrics))
            if session.ended(interruption.asked) or time.monotonic() >= due:
                session.save()
                due = time.monotonic() + checkpoint_every
        return session.finish()


class _Session(Generic[State]):
    """A run in progress: its state, its tally, and its files."""

    def __init__(
        self,
        state: State,
        budget: Budget,
        unit: Unit,
        folder: RunFolder | None,
        resume: bool,
        trace: Callable[[State], Metrics] | None,
    ) -> None:
        self.state = state
        self.resumed = resume and folder is not None and folder.checkpoint.exists()
        self.outcome: tuple[Status, str] | None = None
        self._good = state
        self._tally = Tally()
        self._trace = trace
        self._budget, self._unit = budget, unit
        self._folder = folder
        self._layout = checkpoint.layout(state) if folder else {}
        self._log: RunLog | None = None
        self._offset = 0
        self._earlier = 0.0
        self._ahead = 0.0
        self._began = 0.0
        self._started: float | None = None
        self._stopped: float | None = None
        self._measured = False
        self._peak: int | None = 0
        if folder and self.resumed:
            self.state, extra = checkpoint.load(folder.checkpoint, like=state)
            self._good = self.state
            self._tally = Tally(**extra["tally"])
            self._offset = int(extra["metrics_bytes"])
            self._earlier = self._began = float(extra["seconds"])
            self._peak = extra.get("peak_memory")
            self._ahead = float(extra.get("ahead", 0.0))

    @property
    def spent(self) -> int:
        return self._tally.spent(self._unit)

    @property
    def _share(self) -> float:
        """Share of the budget spent."""
        if isinstance(self._budget, Seconds):
            return self._seconds() / self._budget.seconds
        return self.spent / self._budget

    @property
    def _fits(self) -> bool:
        """Whether there is time for the next step, which may take a little longer than the budget."""
        if not isinstance(self._budget, Seconds):
            return True
        return self._seconds() + self._ahead <= (1.0 + OVER) * self._budget.seconds

    @property
    def _allowed(self) -> str:
        """The budget in words."""
        return str(self._budget) if isinstance(self._budget, Seconds) else f"{self._budget:,} {self._unit}"

    @property
    def _used(self) -> str:
        """What of the budget is spent, as a number in words."""
        return f"{self._seconds():.0f}" if isinstance(self._budget, Seconds) else f"{self.spent:,}"

    def begin(self, stack: ExitStack) -> None:
        """Open the logs, and write the first checkpoint, so that a bad state is refused before any budget is spent."""
        self._started = time.monotonic()
        self._measured = self._folder is not None and forget_peak()
        self._look_at_memory()
        if self._folder:
            self._folder.result.unlink(missing_ok=True)
            self._folder.diverged.unlink(missing_ok=True)
            if self.resumed:  # its policy would look finished if this part were killed
                self._folder.policy.unlink(missing_ok=True)
            self._log = stack.enter_context(self._folder.log(self._offset, self.spent, unit=self._unit))
        if not self.resumed:
            self.save()

    def ended(self, interrupted: bool) -> bool:
        """Whether there is a reason to stop; the first reason is kept."""
        if self.outcome is None:
            if self._tally.converged is not None:
                self.outcome = "converged", self._tally.converged
            elif self._share >= 1.0:
                self.outcome = "finished", f"the budget of {self._allowed} is spent"
            elif not self._fits:
                left = f"too little is left for the next step, of about {self._ahead:.2g} s; give it a larger budget"
                self.outcome = "finished", f"{self._used} of {self._allowed} are spent, and {left}"
            elif interrupted:
                self.outcome = "interrupted", f"interrupted at {self._used} of {self._allowed}"
        return self.outcome is not None

    def moment(self, metrics: Metrics) -> Moment:
        """The progress of the run, for the bar."""
        return Moment(self._tally.fraction(self._share), self.spent, self._tally.stage, metrics)

    def take(self, state: State, epoch: Epoch) -> Metrics:
        """Accept the result of a step, log it, and check that its metrics are finite."""
        seconds = self._seconds()
        of_each = (seconds - self._began) / epoch.control_steps if epoch.control_steps else 0.0
        self._began, self._ahead = seconds, of_each * (epoch.following or 0)
        self.state, self._tally = state, self._tally.plus(epoch)
        self._look_at_memory()
        metrics = {name: float(value) for name, value in epoch.metrics.items()}
        bad = next((name for name, value in metrics.items() if not math.isfinite(value)), None)
        problem = "" if bad is None else f"metric {bad} became {metrics[bad]} while {epoch.stage}"
        traced = metrics
        if self._log and self._trace and not problem:
            try:
                traced = metrics | self._trace(state)
            except np.linalg.LinAlgError as error:
                problem = f"the state has no estimate while {epoch.stage} ({error})"
        if self._log:
            self._log.append(traced, stage=epoch.stage, spent=self.spent, seconds=self._seconds())
        if problem:
            self._diverge(problem)
        return metrics

    def save(self) -> None:
        """Write a checkpoint, unless the state holds a NaN or an infinity."""
        if self.outcome is None or self.outcome[0] != "diverged":
            bad = checkpoint.first_non_finite(self.state)
            if bad:
                self._diverge(f"{bad} holds a NaN or an infinity")
                return
            self._good = self.state
            if self._folder and self._log:
                problem = checkpoint.difference(checkpoint.layout(self.state), self._layout)
                if problem:
                    raise MadocError(f"the method changed the layout of its state: {problem}")
                self._write_state(self._folder.checkpoint, self._log.sync())

    def abandon(self) -> None:
        """Stop inside a step. Its unfinished state is not saved: the last checkpoint stays."""
        sentence = f"interrupted inside a step, at {self._used} of {self._allowed}"
        self.outcome = "interrupted", sentence

    def finish(self) -> Finished[State]:
        """The result; also written as `result.json`, unless an earlier run has written it."""
        if self.outcome is None:
            raise RuntimeError("finish() before the run has ended")
        status, sentence = self.outcome
        if status == "diverged" and self._folder and self._folder.checkpoint.exists():
            self._good, _ = checkpoint.load(self._folder.checkpoint, like=self._good)
        tally, seconds = self._tally, self._seconds()
        if self._folder and not self._folder.result.exists():
            write_peak(self._folder.path, self._peak)
            counts = {"control_steps": tally.control_steps, "updates": tally.updates, "seconds": seconds}
            self._folder.write_json("result.json", {"status": status, "sentence": sentence} | counts)
        return Finished(
            self._good if status == "diverged" else self.state,
            status,
            sentence,
            tally.control_steps,
            tally.updates,
            self.spent,
            seconds,
        )

    def _diverge(self, what: str) -> None:
        where = ""
        if self._folder:
            self._write_state(self._folder.diverged, self._offset)
            where = f"; the bad state is in {self._folder.diverged}"
            if self._folder.checkpoint.exists():
                where += f", the last good one in {self._folder.checkpoint}"
        self.outcome = "diverged", f"stopped at {self.spent:,} {self._unit}: {what}{where}"

    def _seconds(self) -> float:
        """Wall-clock time so far, up to the moment the run ended."""
        if self._started is None:
            return self._earlier
        if self.outcome is None or self._stopped is None:
            self._stopped = time.monotonic()
        return self._earlier + self._stopped - self._started

    def _look_at_memory(self) -> None:
        """Keep the largest peak; None for good once a part of the run has one that is not known."""
        now = peak_memory() if self._measured else None
        self._peak = None if now is None or self._peak is None else max(now, self._peak)

    def _write_state(self, path: Path, metrics_bytes: int) -> None:
        cost = {"seconds": self._seconds(), "peak_memory": self._peak, "ahead": self._ahead}
        extra = {"tally": asdict(self._tally), "metrics_bytes": metrics_bytes} | cost
        checkpoint.save(path, self.state, extra)


def _check_folder(folder: RunFolder | None, resume: bool) -> None:
    if resume and folder is None:
        raise MadocError("cannot resume without a run folder; pass folder=RunFolder.open(path)")
    if folder and not resume and folder.checkpoint.exists():
        raise MadocError(f"{folder.path} already holds a run; pass --resume to go on or choose another --out")
