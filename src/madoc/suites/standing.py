"""How far a suite is: what has ended and how, what is left, for how long, and all of that as rows to print."""

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from madoc.report.words import duration
from madoc.runs.progress import Moment
from madoc.suites.cells import Cell
from madoc.suites.claims import Outcome, outcome_of

_SETTLED = 40
"""Number of ended cells from which the time left is forecast anew only where a tenth more has ended."""
_SAME_METHOD = 3
"""Position of the last level of `_levels` that tells methods apart."""
_SHOWN = ("robot", "task", "name", "method", "at", "seed", "budget")
"""Keys that have a column of their own; the others stand together in the last one."""


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
    """Forecast the cells that are left, of which so many `workers` are done at a time.

    Each is expected to take as long as the mean of those most like it: of the same order but for the seed; else but
    for the log too; else of the same method and robot, in proportion to their budgets; else of the same method; else
    of the same kind; else of any. A cell that was the first of its process, or was begun more than once, counts only
    where there is no other.
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


def _levels(cell: Cell) -> Iterable[tuple[str, float]]:
    """What a cell is like, the nearest first, and the size that its time is in proportion to."""
    asked = cell.asks
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


class Standing:
    """A suite's cells, looked at on the disk again and again.

    Attributes:
        cells: All of them by name.
        ended: Those that have ended, and how.
        left: Names of those that have not, in their order; those that cannot be run are in it.
    """

    def __init__(self, suite: Path, cells: Sequence[Cell], *, workers: int) -> None:
        self.cells = {cell.name: cell for cell in cells}
        self.ended: dict[str, tuple[Cell, Outcome]] = {}
        self.left = dict.fromkeys(self.cells)
        self._suite, self._workers = suite, workers
        self._told: Forecast | None = None
        self.look()

    def look(self) -> int:
        """See what has ended since the last look; how many cells."""
        before = len(self.ended)
        for name in list(self.left):
            outcome = outcome_of(self.cells[name], self._suite)
            if outcome is not None:
                self.ended[name] = self.cells[name], outcome
                del self.left[name]
        return len(self.ended) - before

    @property
    def runnable(self) -> list[Cell]:
        """Cells to do, without those that need a cell that ended without a result."""
        return [self.cells[name] for name in self.left if not self._in_vain(self.cells[name])]

    @property
    def counts(self) -> Counter[str]:
        """Number of cells by how they ended, and of those not run."""
        counts = Counter[str](outcome.status for _, outcome in self.ended.values())
        return counts + Counter({"not run": len(self.left)})

    def forecast(self) -> Forecast:
        """The time that is left."""
        told = self._told
        if told is None or len(self.ended) - told.seen >= max(1, told.seen // 10 if told.seen > _SETTLED else 1):
            told = self._told = forecast(self.runnable, self.ended, workers=self._workers)
        return told

    def moment(self) -> Moment:
        """The progress, for the bar."""
        total, told = len(self.cells), self.forecast()
        left = len(self.runnable)
        seconds = None if told.seconds is None or not told.left else told.seconds * left / told.left
        counts = {
            name: float(count) for name, count in self.counts.items() if name in ("refused", "failed", "diverged")
        }
        return Moment((total - left) / total, len(self.ended), "", counts, seconds)

    def _in_vain(self, cell: Cell) -> bool:
        """Whether a cell cannot be run, because what it needs ended without a result or cannot be run either."""
        if cell.needs is None:
            return False
        if cell.needs in self.ended:
            return not self.ended[cell.needs][1].usable
        return self._in_vain(self.cells[cell.needs])


def rows(standing: Standing) -> list[dict[str, object]]:
    """What each cell asks, and how far it is."""
    return [
        {
            "cell": cell.name,
            "status": standing.ended[cell.name][1].status if cell.name in standing.ended else "not run",
            "kind": cell.kind,
            **asked(cell),
        }
        for cell in standing.cells.values()
    ]


def asked(cell: Cell) -> dict[str, object]:
    """What a cell asks, by the keys of a suite file; values left at their default are not among them."""
    robot = {"robot": cell.robot} if cell.robot else {}
    needs = {"needs": cell.needs} if cell.needs else {}
    return robot | cell.asks | needs


def lines(listed: Sequence[dict[str, object]]) -> tuple[str, ...]:
    """The rows as text in columns."""
    table = [("cell", "status", "kind", "asks"), *(_texts(row) for row in listed)]
    widths = [max(len(row[column]) for row in table) for column in range(3)]
    text = "\n".join(
        "  ".join([*(part.ljust(width) for part, width in zip(row, widths, strict=False)), row[3]]) for row in table
    )
    return (text,)


def _texts(row: dict[str, object]) -> tuple[str, str, str, str]:
    """The texts of a row's four columns."""
    rest = [key for key in row if key not in (*_SHOWN, "cell", "status", "kind")]
    words = [_word(key, row[key]) for key in (*_SHOWN, *rest) if key in row]
    return str(row["cell"]), str(row["status"]), str(row["kind"]), " ".join(words)


def _word(key: str, value: object) -> str:
    if key in ("task", "name"):
        return Path(str(value)).name
    if key == "data" and isinstance(value, list):
        value = ",".join(Path(str(path)).name for path in value)
    if key == "set" and isinstance(value, list):
        value = ",".join(str(text) for group in value for text in group)
    return f"{key}={value}"
