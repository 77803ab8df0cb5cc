"""What a command returns and prints, and the options that all commands share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rich.console import RenderableType
from rich.table import Table

EXIT_CODES: Mapping[str, int] = {
    "finished": 0,
    "converged": 0,
    "diverged": 1,
    "rejected": 2,
    "interrupted": 130,
    "CALIBRATED": 0,
    "USABLE": 9,
    "NO_IMPROVEMENT": 10,
    "NOT_IDENTIFIABLE": 11,
    "MODEL_MISMATCH": 12,
    "DATA_REJECTED": 13,
    "NOT_RECOVERABLE": 14,
}
"""Exit codes by the status of a run, or by its verdict where it has one; 2 is a refusal."""


@dataclass(frozen=True)
class Answer:
    """The outcome of a command: what is printed with `--json` and without, and a key of `EXIT_CODES`."""

    json: Mapping[str, object]
    text: tuple[RenderableType, ...]
    status: str = "finished"


@dataclass(frozen=True)
class Output:
    """What is shown."""

    quiet: bool = False
    """Show no progress."""
    json: bool = False
    """Print exactly one JSON object on standard output."""


def table_of(title: str, words: Sequence[str], numbers: Sequence[str] = ()) -> Table:
    """A table with headings of columns of words, and after them of columns of numbers."""
    table = Table(*words, title=title, title_justify="left")
    for heading in numbers:
        table.add_column(heading, justify="right")
    return table
