"""What a user sees of work under way, a bar in a terminal and lines anywhere else, and how it is asked to stop."""

import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType

from madoc.types import Metrics

LINE_SECONDS = 10.0
"""Shortest time in s between two plain lines of one stage."""

_WINDOW_SECONDS = 30.0
"""Length in s of the most recent period, from which the rate and the time left are computed."""


@dataclass(frozen=True)
class Moment:
    """The progress of some work at one moment.

    Attributes:
        fraction: Share that is done, from 0 to 1.
        done: The same as a count, in the work's unit.
        stage: The present stage, in a short word.
        metrics: Numbers to show beside it; of more than three, the first three are shown.
        seconds_left: Time left in s, where more is known of it than the pace so far.
    """

    fraction: float
    done: int
    stage: str = ""
    metrics: Metrics = field(default_factory=dict)
    seconds_left: float | None = None


Show = Callable[[Moment], None]


@contextmanager
def display(description: str, *, unit: str, quiet: bool = False) -> Iterator[Show]:
    """Show the progress of work whose caller tells the share that is done.

    `with display("Madoc", unit="control steps") as show: show(Moment(0.1, 500, "cloning"))`.
    """
    if quiet:
        yield lambda moment: None
    else:
        with (_bar if sys.stderr.isatty() else _lines)(description, unit) as show:
            yield show


@contextmanager
def bar(description: str, *, total: int, unit: str, quiet: bool = False) -> Iterator[Callable[[int], None]]:
    """Show work of a known size.

    `with bar("recording", total=len(rows), unit="rows") as advance: advance(100)`.
    """
    done = 0
    with display(description, unit=unit, quiet=quiet) as show:

        def advance(count: int) -> None:
            nonlocal done
            done += count
            show(Moment(min(done / total, 1.0) if total else 1.0, done))

        yield advance


@contextmanager
def waiting(description: str, *, quiet: bool = False) -> Iterator[Callable[[str], None]]:
    """Show work whose length nobody knows, with the time that it has taken.

    It is a moving bar in a terminal, and a line at its begin and one at its end anywhere else. The function that it
    gives is told of each part of the work.
    """
    started = time.monotonic()
    if quiet:
        yield lambda part: None
    elif sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
        with Progress(*columns, console=Console(stderr=True)) as progress:
            task = progress.add_task(description, total=None)
            yield lambda part: progress.update(task, description=f"{description}: {part}")
            progress.update(task, total=1.0, completed=1.0)
    else:
        print(f"{description}: begun", file=sys.stderr, flush=True)
        yield lambda part: print(f"{description}: {part}", file=sys.stderr, flush=True)
        print(f"{description}: done, {_clock(time.monotonic() - started)} elapsed", file=sys.stderr, flush=True)


class _Pace:
    """The rate of the work and the time left, from the moments of the last `_WINDOW_SECONDS`.

    Of work so slow that nothing was done in that time, they are those since its beginning.
    """

    def __init__(self, unit: str) -> None:
        self._unit = unit
        self._started = time.monotonic()
        self._seen: deque[tuple[float, Moment]] = deque()
        self._first: tuple[float, Moment] | None = None

    def words(self, moment: Moment) -> tuple[str, str, str]:
        """The rate, the time elapsed, and the time left, at a moment."""
        now = time.monotonic()
        self._seen.append((now, moment))
        self._first = self._first or (now, moment)
        while len(self._seen) > 2 and self._seen[1][0] < now - _WINDOW_SECONDS:
            self._seen.popleft()
        then, before = self._seen[0] if moment.done > self._seen[0][1].done else self._first
        seconds, done, fraction = now - then, moment.done - before.done, moment.fraction - before.fraction
        rate = _rate(done / seconds, self._unit) if seconds > 0 and done > 0 else f"- {self._unit}/s"
        left = moment.seconds_left
        if left is None and fraction > 0:
            left = (1.0 - moment.fraction) * seconds / fraction
        elapsed = _clock(now - self._started)
        return rate, f"{elapsed} elapsed", f"{'-:--' if left is None else _clock(left)} left"


@contextmanager
def _lines(description: str, unit: str) -> Iterator[Show]:
    """Plain lines for a log file: one when a stage begins, one every `LINE_SECONDS`, one at the end."""
    pace = _Pace(unit)
    stage: str | None = None
    printed = 0.0
    line = ""

    def show(moment: Moment) -> None:
        nonlocal stage, printed, line
        head = " ".join(word for word in (description, moment.stage) if word)
        done = [f"{100 * moment.fraction:.0f}%", f"{moment.done:,} {unit}"]
        parts = ", ".join([*done, *pace.words(moment), *_metrics(moment)])
        line = f"{head}: {parts}" if head else parts
        if moment.stage != stage or time.monotonic() - printed >= LINE_SECONDS:
            stage, printed = moment.stage, time.monotonic()
            print_line()

    def print_line() -> None:
        nonlocal line
        print(line, file=sys.stderr, flush=True)
        line = ""

    try:
        yield show
    finally:
        if line:
            print_line()


@contextmanager
def _bar(description: str, unit: str) -> Iterator[Show]:
    """A Rich bar that redraws itself."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    def text(name: str) -> TextColumn:
        return TextColumn(f"{{task.fields[{name}]}}", markup=False)

    pace = _Pace(unit)
    percentage = TextColumn("{task.percentage:>3.0f}%")
    after = (text("rate"), TimeElapsedColumn(), text("left"), text("metrics"))
    columns = (TextColumn("{task.description}", markup=False), text("stage"), BarColumn(), percentage, *after)
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(description, total=1.0, stage="", rate="", left="", metrics="")

        def show(moment: Moment) -> None:
            metrics = "  ".join(_metrics(moment))
            rate, _, left = pace.words(moment)
            progress.update(task, completed=moment.fraction, stage=moment.stage, rate=rate, left=left, metrics=metrics)

        yield show


def _metrics(moment: Moment) -> list[str]:
    return [f"{name} {value:.4g}" for name, value in list(moment.metrics.items())[:3]]


def _rate(rate: float, unit: str) -> str:
    """A rate per second, or per minute or hour where that is the first with a whole one."""
    for seconds, name in ((1, "s"), (60, "min")):
        if seconds * rate >= 1.0:
            return f"{seconds * rate:,.0f} {unit}/{name}"
    return f"{3600 * rate:,.1f} {unit}/h"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


class Interruption:
    """Ctrl-C or SIGTERM as a request to stop, which is obeyed between two steps; a second one breaks a step off."""

    def __init__(self) -> None:
        self.asked = False
        self._breakable = False

    @contextmanager
    def breakable(self) -> Iterator[None]:
        """A block that a second request leaves with KeyboardInterrupt; no files may be written in it."""
        self._breakable = True
        try:
            yield
        finally:
            self._breakable = False

    def ask(self, number: int, frame: FrameType | None) -> None:
        """The signal handler."""
        if self.asked and self._breakable:
            raise KeyboardInterrupt
        self.asked = True


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """Handle SIGINT and SIGTERM in the block, if it runs in the main thread; other threads may not."""
    interruption = Interruption()
    previous = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            previous[number] = signal.signal(number, interruption.ask)
    try:
        yield interruption
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
