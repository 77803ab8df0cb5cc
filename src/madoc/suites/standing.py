"""How far a suite is: what has ended and how, what is left, and for how long."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from madoc.runs.progress import Moment
from madoc.suites.cells import Cell
from madoc.suites.claims import Outcome, outcome_of
from madoc.suites.forecast import Forecast, forecast

_SETTLED = 40
"""Number of ended cells from which the time left is forecast anew only where a tenth more has ended."""


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
        last = self._told
        if last is None or len(self.ended) - last.seen >= max(1, last.seen // 10 if last.seen > _SETTLED else 1):
            self._told = forecast(self.runnable, self.ended, workers=self._workers)
        assert self._told is not None
        return self._told

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
