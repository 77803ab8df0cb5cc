"""Cells claimed by one process at a time, and how each of them ended.

A claim is a lock on a file of the cell's folder. The system gives it back when its process ends, however it ends.
"""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import filelock

from madoc.errors import MadocError
from madoc.runs.files import read_json, remove_leftovers, write_json
from madoc.runs.run_folder import ENDED
from madoc.suites.cells import Cell

Ending = Literal["finished", "converged", "diverged", "refused", "failed"]

MOST_ATTEMPTS = 10
"""How often a cell is begun without getting any further than the time before; then it has failed."""
_OUTCOME, _ATTEMPTS = "outcome.json", "attempts.json"


@dataclass(frozen=True)
class Outcome:
    """How a cell ended.

    Attributes:
        status: `finished` or `converged`; `diverged` (a value became NaN or infinite), `refused` (with a reason), or
            `failed` (an error that is no refusal, which the next `madoc suite` tries again).
        sentence: The status in words.
        seconds: Wall-clock time of the attempt that ended it, s.
        attempts: How often it had been begun.
        host: Name of the machine.
        fresh: Whether it was the first cell of its process, which compiles what the later ones reuse.
    """

    status: Ending
    sentence: str
    seconds: float
    attempts: int
    host: str
    fresh: bool = False

    @property
    def usable(self) -> bool:
        """Whether other cells can take its result."""
        return self.status in ENDED


class Claim:
    """A cell that this process alone works on; `attempts` to get further were made in its folder, this one included."""

    def __init__(self, cell: Cell, folder: Path, *, fresh: bool) -> None:
        self.cell, self.folder, self._fresh = cell, folder, fresh
        self.attempts = _futile(folder) + 1
        write_json(folder / _ATTEMPTS, {"count": self.attempts, "logged": _progress(folder)})

    def take_back(self) -> None:
        """Count this attempt for nothing, as the cell was not begun."""
        write_json(self.folder / _ATTEMPTS, {"count": self.attempts - 1, "logged": _progress(self.folder)})

    def end(self, status: Ending, sentence: str, seconds: float) -> Outcome:
        """Write down how the cell ended."""
        outcome = Outcome(status, sentence, round(seconds, 3), self.attempts, socket.gethostname(), self._fresh)
        write_json(self.folder / _OUTCOME, asdict(outcome))
        return outcome


@contextmanager
def claimed(cell: Cell, suite: Path, *, fresh: bool = False) -> Iterator[Claim | None]:
    """A cell claimed for the block; None where another process has it, or it has ended.

    Raises:
        MadocError: Its folder cannot be made or locked.
    """
    folder = cell.folder(suite)
    lock = filelock.FileLock(folder / ".claim", timeout=0, thread_local=False)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except filelock.Timeout:
        yield None
        return
    except OSError as error:
        raise MadocError(f"could not claim {folder}: {error.strerror or error}") from error
    try:
        remove_leftovers(folder)
        yield None if outcome_of(cell, suite) is not None else Claim(cell, folder, fresh=fresh)
    finally:
        lock.release()


def outcome_of(cell: Cell, suite: Path) -> Outcome | None:
    """How a cell ended; None while it has not."""
    file = cell.folder(suite) / _OUTCOME
    try:
        return Outcome(**read_json(file)) if file.exists() else None
    except TypeError as error:
        raise MadocError(f"{file} is damaged ({error}); delete it to run the cell again") from error


def attempts_of(cell: Cell, suite: Path) -> int:
    """How often a cell was begun without getting any further than the time before."""
    return _futile(cell.folder(suite))


def try_again(cell: Cell, suite: Path) -> bool:
    """Forget that a cell has failed, so that it is begun again; whether it had."""
    outcome = outcome_of(cell, suite)
    if outcome is None or outcome.status != "failed":
        return False
    for name in (_OUTCOME, _ATTEMPTS):
        (cell.folder(suite) / name).unlink(missing_ok=True)
    return True


def _futile(folder: Path) -> int:
    """How often a run was begun since its log last grew."""
    file = folder / _ATTEMPTS
    before = read_json(file) if file.exists() else {"count": 0, "logged": 0}
    return before["count"] if before["logged"] == _progress(folder) else 0


def _progress(folder: Path) -> int:
    """How far a run is: the size of its log in bytes."""
    log = folder / "metrics.jsonl"
    return log.stat().st_size if log.exists() else 0
