"""How long the cells that are left will take, from those of their kind that have ended."""

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from madoc.report.words import duration
from madoc.suites.cells import KINDS, Cell
from madoc.suites.claims import Outcome
from madoc.suites.options import flat


@dataclass(frozen=True)
class Forecast:
    """The time that is left.

    Attributes:
        seconds: Expected wall-clock time in s with that many workers; None while no cell of any kind has ended.
        left: Number of cells to go.
        seen: Number of cells that have ended, from which it is told.
        unlike: Number of cells to go of whose method none has ended, so that they are counted like all others.
    """

    seconds: float | None
    left: int
    seen: int
    unlike: int

    def sentence(self, workers: int) -> str:
        """The forecast in words."""
        if not self.left:
            return "nothing is left to do"
        if self.seconds is None:
            return f"{self.left:,} cells to do; how long they take is not known before the first has ended"
        doubt = f"; of the methods of {self.unlike:,} of them none has ended yet" if self.unlike else ""
        return f"{self.left:,} cells to do: about {duration(self.seconds)} with {workers} at a time{doubt}"


def forecast(left: Iterable[Cell], ended: Mapping[str, tuple[Cell, Outcome]], *, workers: int) -> Forecast:
    """Forecast the cells that are left.

    Each is expected to take as long as the mean of those most like it: of the same order but for the seed; else but
    for the log too; else of the same method and robot, in proportion to their budgets; else of the same method; else
    of the same kind; else of any. A cell that was the first of its process, or was begun more than once, counts only
    where there is no other.

    Args:
        left: The cells to do.
        ended: Those that have ended, and how.
        workers: How many are done at a time.
    """
    means = _means(list(ended.values()))
    expected: list[float | None] = []
    unlike = 0
    for cell in left:
        levels = list(_levels(cell))
        level = next((n for n, (key, _) in enumerate(levels) if key in means), None)
        if level is None:
            expected.append(None)
            continue
        key, size = levels[level]
        expected.append(means[key] * size)
        unlike += level > _SAME_METHOD
    if not expected or None in expected:
        return Forecast(None if expected else 0.0, len(expected), len(ended), unlike)
    known = [seconds for seconds in expected if seconds is not None]
    return Forecast(max(sum(known) / workers, *known), len(known), len(ended), unlike)


_SAME_METHOD = 3
"""Position of the last level of `_levels` that tells methods apart."""


def _levels(cell: Cell) -> Iterable[tuple[str, float]]:
    """What a cell is like, the nearest first, and the size that its time is in proportion to."""
    asked = flat(KINDS[cell.kind], cell.order)
    asked.pop("seed", None)
    budget = asked.get("budget")
    size = float(budget) if isinstance(budget, int) else 1.0
    unit = "budget" if isinstance(budget, int) else ""
    yield json.dumps([cell.kind, asked]), 1.0
    asked.pop("data", None)
    yield json.dumps([cell.kind, "log", asked]), 1.0
    method = str(asked.get("method", asked.get("name", "")))
    yield json.dumps([cell.kind, method, asked.get("task"), unit]), size
    yield json.dumps([cell.kind, method]), 1.0
    yield cell.kind, 1.0
    yield "any", 1.0


def _means(ended: Sequence[tuple[Cell, Outcome]]) -> dict[str, float]:
    """Mean seconds, for each size, of the cells that have ended, by what they are like."""
    clean, other = defaultdict[str, list[float]](list), defaultdict[str, list[float]](list)
    for cell, outcome in ended:
        if outcome.status in ("failed", "refused"):
            continue
        into = other if outcome.fresh or outcome.attempts > 1 else clean
        for key, size in _levels(cell):
            into[key].append(outcome.seconds / size)
    return {key: fmean(seconds) for key, seconds in {**other, **clean}.items()}
