"""One loop runs every method, calibrator or policy learner, under a budget of control steps or of updates."""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Generic, Literal, Protocol, TypeVar

from jaxtyping import PRNGKeyArray

from madoc.errors import MadocError
from madoc.runs import checkpoint
from madoc.runs.interruption import interruptible
from madoc.runs.progress import Moment, display
from madoc.runs.run_folder import RunFolder, RunLog, count_name
from madoc.types import Metrics, Unit

Problem = TypeVar("Problem", contravariant=True)
State = TypeVar("State")

Status = Literal["finished", "converged", "interrupted", "diverged"]


class Method(Protocol[Problem, State]):
    """What the loop needs of a calibrator or a policy learner: hyperparameters, and functions of a state.

    A state is a pytree of JAX arrays, NumPy arrays, typed random keys, Python numbers, strings and functions.
    It carries everything the method needs to go on. Its structure, shapes and dtypes stay those of `init`,
    and a healthy state holds no NaN and no infinity, not even as a marker.
    """

    def init(self, problem: Problem, key: PRNGKeyArray) -> State:
        """The state before the first epoch. Cheap: a resumed run calls it too, for the structure."""
        ...

    def step(self, problem: Problem, state: State) -> tuple[State, Metrics]:
        """One epoch, 0.1 to 2 seconds: the new state, and finite scalars worth looking at."""
        ...

    def control_steps(self, state: State) -> int:
        """Simulated control steps spent so far; 0 for ever where the method does not simulate."""
        ...

    def stage(self, state: State) -> str:
        """What the next step does, in one short word: `cloning`, `grouping`, `calibrating`, `learning`."""
        ...

    def progress(self, state: State, budget: int) -> float:
        """How much is done, 0 to 1, stages that simulate nothing included."""
        ...

    def converged(self, state: State) -> str | None:
        """None to go on, else a sentence saying why the method stopped by itself."""
        ...


@dataclass(frozen=True)
class Finished(Generic[State]):
    """How a run ended.

    Attributes:
        state: The last state; the bad one if the run diverged.
        status: "finished" (budget spent), "converged", "interrupted" (by the user) or "diverged" (NaN).
        sentence: The status in words.
        control_steps: Simulated control steps spent.
        spent: What the budget counts.
        seconds: Wall-clock time, that before a resume included.
    """

    state: State
    status: Status
    sentence: str
    control_steps: int
    spent: int
    seconds: float


def run(
    method: Method[Problem, State],
    problem: Problem,
    *,
    key: PRNGKeyArray,
    budget: int,
    folder: RunFolder | None = None,
    resume: bool = False,
    quiet: bool = False,
    description: str = "",
    shown: Sequence[str] = (),
    checkpoint_every: float = 30.0,
    unit: Unit = "control steps",
    spent: Callable[[State], int] | None = None,
    trace: Callable[[State], Metrics] | None = None,
) -> Finished[State]:
    """Run a method until its budget is spent, it has converged, the user stops it, or a NaN appears.

    A run killed at any moment and resumed ends with the same bits as one that was not. Ctrl-C (or SIGTERM)
    ends the run after the current step, with a checkpoint; a second one abandons the step.

    Args:
        method: What to run.
        problem: What to run it on.
        key: The only source of randomness; on resume, the same key again.
        budget: In `unit`; the step that reaches it is the last.
        folder: Where to write logs, checkpoints and `result.json`; None to write nothing.
        resume: Go on from the folder's checkpoint, or from the start if it was killed before the first one.
            A run that had ended comes back as it is, unless `budget` grew.
        quiet: Show no progress.
        description: What the progress bar is called.
        shown: Metrics shown beside the bar, at most three; the first three if none is named.
        checkpoint_every: Seconds between two checkpoints.
        unit: What the budget counts.
        spent: How many of them a state has spent; `method.control_steps` where it is None.
        trace: More finite scalars of a state, for the log alone.

    Raises:
        MadocError: The budget is not positive, there is no folder to resume, the folder holds a run and
            `resume` is false, the checkpoint is damaged or another method's, or the state cannot be saved.
    """
    if budget < 1:
        raise MadocError(f"expected a budget of at least 1 {unit.removesuffix('s')}, got {budget}")
    _check_folder(folder, resume)
    with ExitStack() as stack:
        interruption = stack.enter_context(interruptible())
        allowance = _Allowance(budget, unit, spent or method.control_steps)
        session = _Session(method, allowance, method.init(problem, key), folder, resume, trace)
        if session.ended(interruption.asked) and session.resumed:
            return session.finish()
        session.begin(stack)
        show = stack.enter_context(display(description, unit=unit, quiet=quiet))
        show(session.moment({}))
        due = time.monotonic() + checkpoint_every
        while session.outcome is None:
            stage = method.stage(session.state)
            try:
                with interruption.breakable():
                    state, metrics = method.step(problem, session.state)
            except KeyboardInterrupt:
                session.abandon()
                break
            metrics = session.take(state, metrics, stage)
            show(session.moment({name: metrics[name] for name in shown if name in metrics} or metrics))
            if session.ended(interruption.asked) or time.monotonic() >= due:
                session.save()
                due = time.monotonic() + checkpoint_every
        return session.finish()


@dataclass(frozen=True)
class _Allowance(Generic[State]):
    """The budget, what it counts, and how many of them a state has spent."""

    budget: int
    unit: Unit
    spent: Callable[[State], int]


class _Session(Generic[State]):
    """A run under way: its state, and what of it is on the disk."""

    def __init__(
        self,
        method: Method[Any, State],
        allowance: _Allowance[State],
        state: State,
        folder: RunFolder | None,
        resume: bool,
        trace: Callable[[State], Metrics] | None,
    ) -> None:
        self.state = state
        self._trace = trace
        self.resumed = resume and folder is not None and folder.checkpoint.exists()
        self.outcome: tuple[Status, str] | None = None
        self._method = method
        self._allowance = allowance
        self._budget, self._unit = allowance.budget, allowance.unit
        self._folder = folder
        self._layout = checkpoint.layout(state) if folder else {}
        self._log: RunLog | None = None
        self._offset = 0
        self._earlier = 0.0
        self._started: float | None = None
        self._stopped: float | None = None
        if folder and self.resumed:
            self.state, extra = checkpoint.load(folder.checkpoint, like=state)
            self._offset = int(extra["metrics_bytes"])
            self._earlier = float(extra["seconds"])

    @property
    def control_steps(self) -> int:
        return int(self._method.control_steps(self.state))

    @property
    def spent(self) -> int:
        return int(self._allowance.spent(self.state))

    def begin(self, stack: ExitStack) -> None:
        """Open the logs; write the first checkpoint, which refuses a bad state before any budget is spent."""
        self._started = time.monotonic()
        if self._folder:
            self._folder.result.unlink(missing_ok=True)
            self._folder.diverged.unlink(missing_ok=True)
            self._log = stack.enter_context(self._folder.log(self._offset, self.spent, unit=self._unit))
        if not self.resumed:
            self.save()

    def ended(self, interrupted: bool) -> bool:
        """Whether there is a reason to stop; the first one found stays the reason."""
        if self.outcome is None:
            spent = self.spent
            why = self._method.converged(self.state)
            if why is not None:
                self.outcome = "converged", why
            elif spent >= self._budget:
                self.outcome = "finished", f"the budget of {self._budget:,} {self._unit} is spent"
            elif interrupted:
                self.outcome = "interrupted", f"interrupted at {spent:,} of {self._budget:,} {self._unit}"
        return self.outcome is not None

    def moment(self, metrics: Metrics) -> Moment:
        """Where the run stands, for the progress bar."""
        fraction = min(max(self._method.progress(self.state, self._budget), 0.0), 1.0)
        return Moment(fraction, self.spent, self._method.stage(self.state), metrics)

    def take(self, state: State, metrics: Metrics, stage: str) -> Metrics:
        """Accept the result of a step, log it, and look at its metrics."""
        self.state = state
        metrics = {name: float(value) for name, value in metrics.items()}
        if self._log:
            traced = metrics | (self._trace(state) if self._trace else {})
            self._log.append(traced, stage=stage, spent=self.spent, seconds=self._seconds())
        for name, value in metrics.items():
            if not math.isfinite(value):
                self._diverge(f"metric {name} became {value} while {stage}")
                break
        return metrics

    def save(self) -> None:
        """Write a checkpoint; never a bad one."""
        if self.outcome is None or self.outcome[0] != "diverged":
            bad = checkpoint.first_non_finite(self.state)
            if bad:
                self._diverge(f"{bad} holds a NaN or an infinity")
            elif self._folder and self._log:
                problem = checkpoint.difference(checkpoint.layout(self.state), self._layout)
                if problem:
                    raise MadocError(f"{type(self._method).__name__} changed the layout of its state: {problem}")
                extra = self._extra() | {"metrics_bytes": self._log.sync()}
                checkpoint.save(self._folder.checkpoint, self.state, extra)

    def abandon(self) -> None:
        """Stop inside a step. What it may have left half-changed is not saved: the last checkpoint stays."""
        sentence = f"interrupted inside a step, at {self.spent:,} of {self._budget:,} {self._unit}"
        self.outcome = "interrupted", sentence

    def finish(self) -> Finished[State]:
        """The result, also as `result.json`; one of a run that had ended before is left as it is."""
        if self.outcome is None:
            raise RuntimeError("finish() before the run has ended")
        status, sentence = self.outcome
        finished = Finished(self.state, status, sentence, self.control_steps, self.spent, self._seconds())
        if self._folder and not self._folder.result.exists():
            self._folder.write_json("result.json", {"status": status, "sentence": sentence} | self._extra())
        return finished

    def _diverge(self, what: str) -> None:
        where = ""
        if self._folder:
            checkpoint.save(self._folder.diverged, self.state, self._extra())
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

    def _extra(self) -> dict[str, Any]:
        return {count_name(self._unit): self.spent, "control_steps": self.control_steps, "seconds": self._seconds()}


def _check_folder(folder: RunFolder | None, resume: bool) -> None:
    if resume and folder is None:
        raise MadocError("cannot resume without a run folder; pass folder=RunFolder.open(path)")
    if folder and not resume and folder.checkpoint.exists():
        raise MadocError(f"{folder.path} already holds a run; pass --resume to go on or choose another --out")
