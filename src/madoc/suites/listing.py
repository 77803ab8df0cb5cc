"""The cells of a suite as rows to print."""

from collections.abc import Sequence
from pathlib import Path

from madoc.suites.cells import KINDS, Cell
from madoc.suites.options import flat
from madoc.suites.standing import Standing

_SHOWN = ("robot", "task", "name", "method", "at", "seed", "budget")
"""Keys that have a column of their own; the others stand together in the last one."""


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
    values = flat(KINDS[cell.kind], cell.order)
    robot = {"robot": cell.robot} if cell.robot else {}
    needs = {"needs": cell.needs} if cell.needs else {}
    return robot | values | needs


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
