"""Progress on standard error: a bar in a terminal, a line every few seconds anywhere else."""

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

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
    """

    fraction: float
    done: int
    stage: str = ""
    metrics: Metrics = field(default_factory=dict)


Show = Callable[[Moment], None]


@contextmanager
def display(description: str, *, unit: str, quiet: bool = False) -> Iterator[Show]:
    """Show the progress of work of unknown size.

    `with display("Madoc", unit="control steps") as show: show(Moment(0.1, 500, "cloning"))`.
    """
    if quiet:
        yield lambda moment: None
    elif sys.stderr.isatty():
        with _bar(description, unit) as show:
            yield show
    else:
        lines = _Lines(description, unit)
        try:
            yield lines.show
        finally:
            lines.finish()


@contextmanager
def bar(description: str, *, total: int, unit: str, quiet: bool = False) -> Iterator[Callable[[int], None]]:
    """Show work of a known size.

    `with bar("recording", total=len(rows), unit="rows") as advance: advance(100)`.
    """
    done = 0
    with display(description, unit=unit, quiet=quiet) as show:

        def advance(count: int = 1) -> None:
            nonlocal done
            done += count
            show(Moment(min(done / total, 1.0) if total else 1.0, done))

        yield advance


class _Pace:
    """The rate and the time left, computed from the most recent moments."""

    def __init__(self, unit: str) -> None:
        self._unit = unit
        self._started = time.monotonic()
        self._seen: deque[tuple[float, Moment]] = deque()

    def see(self, moment: Moment) -> None:
        now = time.monotonic()
        self._seen.append((now, moment))
        while len(self._seen) > 2 and self._seen[1][0] < now - _WINDOW_SECONDS:
            self._seen.popleft()

    def rate(self) -> str:
        (then, before), (now, moment) = self._seen[0], self._seen[-1]
        per_second = (moment.done - before.done) / (now - then) if now > then else 0.0
        return f"{per_second:,.0f} {self._unit}/s" if per_second > 0 else f"- {self._unit}/s"

    def left(self) -> str:
        (then, before), (now, moment) = self._seen[0], self._seen[-1]
        gained = moment.fraction - before.fraction
        return _clock((1.0 - moment.fraction) * (now - then) / gained) if gained > 0 else "-:--"

    def elapsed(self) -> str:
        return _clock(time.monotonic() - self._started)


class _Lines:
    """Plain lines for a log file: one when a stage begins, one every `LINE_SECONDS`, one at the end."""

    def __init__(self, description: str, unit: str) -> None:
        self._description = description
        self._unit = unit
        self._pace = _Pace(unit)
        self._stage: str | None = None
        self._printed = 0.0
        self._unprinted: Moment | None = None

    def show(self, moment: Moment) -> None:
        self._pace.see(moment)
        self._unprinted = moment
        if moment.stage != self._stage or time.monotonic() - self._printed >= LINE_SECONDS:
            self._print(moment)

    def finish(self) -> None:
        if self._unprinted is not None:
            self._print(self._unprinted)

    def _print(self, moment: Moment) -> None:
        self._stage, self._printed, self._unprinted = moment.stage, time.monotonic(), None
        parts = [
            f"{100 * moment.fraction:.0f}%",
            f"{moment.done:,} {self._unit}",
            self._pace.rate(),
            f"{self._pace.elapsed()} elapsed",
            f"{self._pace.left()} left",
            *_metrics(moment),
        ]
        head = " ".join(word for word in (self._description, moment.stage) if word)
        print(f"{head}: {', '.join(parts)}" if head else ", ".join(parts), file=sys.stderr, flush=True)


@contextmanager
def _bar(description: str, unit: str) -> Iterator[Show]:
    """A Rich bar that redraws itself."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    def text(name: str) -> TextColumn:
        return TextColumn(f"{{task.fields[{name}]}}", markup=False)

    pace = _Pace(unit)
    columns = (
        TextColumn("{task.description}", markup=False),
        text("stage"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}%"),
        text("rate"),
        TimeElapsedColumn(),
        text("left"),
        text("metrics"),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(description, total=1.0, stage="", rate="", left="", metrics="")

        def show(moment: Moment) -> None:
            pace.see(moment)
            progress.update(
                task,
                completed=moment.fraction,
                stage=moment.stage,
                rate=pace.rate(),
                left=f"{pace.left()} left",
                metrics="  ".join(_metrics(moment)),
            )

        yield show


def _metrics(moment: Moment) -> list[str]:
    return [f"{name} {value:.4g}" for name, value in list(moment.metrics.items())[:3]]


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
