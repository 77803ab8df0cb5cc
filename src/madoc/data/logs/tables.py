"""The result of every reader of logs: runs, each with tables of named columns."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from madoc.errors import MadocError

WIDEST = 1000
"""Number of values per row; an array with more is taken for a picture and not read."""

MISSING = frozenset(("", "nan", "na", "n/a", "none", "null", "-"))
"""Words, in lower case, in the place of a number that is not there."""


@dataclass(frozen=True)
class Table:
    """Columns that were written together, row by row.

    Attributes:
        columns: By name, all equally long: numbers, flags, times (datetime64), or text that may be numbers.
        clock: The column with the format's own time, in s; None where the format has none.
        lines: The line of each row in a text file; None for other formats.
        others: The kind of each array that is not one number per row, by name.
    """

    columns: Mapping[str, np.ndarray]
    clock: str | None = None
    lines: Int[np.ndarray, " rows"] | None = None
    others: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def place(self, row: int) -> str:
        """The name of a row in an error."""
        return f"row {row}" if self.lines is None else f"line {self.lines[row]}"


@dataclass(frozen=True)
class Run:
    """One recording: a file, or an episode in one.

    Attributes:
        name: The file, and the episode in it.
        tables: Tables, each with one clock. Most formats have one table; MCAP has one per topic.
        timed: Whether the format keeps times; otherwise its rows are one control step apart by definition.
    """

    name: str
    tables: tuple[Table, ...]
    timed: bool = True

    @property
    def names(self) -> list[str]:
        """Names of all columns that can be read."""
        return list(dict.fromkeys(name for table in self.tables for name in table.columns))


def tables_of(arrays: Mapping[str, np.ndarray], *, clock: str | None = None) -> tuple[Table, ...]:
    """Arrays as tables, one for each length; a matrix becomes columns `name[0]`, `name[1]`, ...

    Scalars, pictures and objects are left out, but for their names.
    """
    grouped: dict[int, dict[str, np.ndarray]] = {}
    others: dict[str, str] = {}
    for name, array in arrays.items():
        what = _unreadable(array)
        if what:
            others[name] = what
        elif array.ndim == 1 or array.shape[1] == 1:
            grouped.setdefault(len(array), {})[name] = array.reshape(-1)
        else:
            grouped.setdefault(len(array), {}).update({f"{name}[{at}]": column for at, column in enumerate(array.T)})
    tables = (
        Table(columns, clock if clock in columns else None, others=others) for columns in grouped.values() if columns
    )
    return tuple(tables) or (Table({}, others=others),)


def _unreadable(array: np.ndarray) -> str:
    """The kind of an array that is not numbers, flags, times or text by row; empty for others."""
    if array.ndim == 0:
        return "a single value"
    if array.ndim > 2 or (array.ndim == 2 and array.shape[1] > WIDEST):
        return f"an array of shape {array.shape}"
    return "" if array.dtype.kind in "fiubMmUSO" else f"of type {array.dtype}"


def as_numbers(table: Table, name: str, run: str) -> Float[np.ndarray, " rows"]:
    """A column as float64; an empty cell, `nan` or `null` is NaN, times are s since the first row; text is refused."""
    values = table.columns[name]
    if values.dtype.kind in "fiub":
        return values.astype(np.float64)
    if values.dtype.kind in "Mm":
        return _seconds(values)
    return np.array([_number(cell, table, name, run, row) for row, cell in enumerate(values)], dtype=np.float64)


def _seconds(values: np.ndarray) -> Float[np.ndarray, " rows"]:
    """Times as s since the first one; whole nanoseconds are subtracted before anything is rounded."""
    kind = "datetime64[ns]" if values.dtype.kind == "M" else "timedelta64[ns]"
    missing = np.isnat(values)
    whole = values.astype(kind).astype(np.int64)
    return np.where(missing, np.nan, (whole - whole[missing.argmin()]) / 1e9)


def _number(cell: object, table: Table, name: str, run: str, row: int) -> float:
    text = cell.decode(errors="replace") if isinstance(cell, bytes) else "" if cell is None else str(cell)
    bare = text.strip()
    if bare.lower() in MISSING:
        return np.nan
    try:
        if "_" not in bare:  # Python reads 1_000
            return float(bare)
    except ValueError:
        pass
    shown = bare if len(bare) <= 30 else bare[:27] + "..."
    raise MadocError(f"expected a number in column {name!r} of {run}, got {shown!r} in {table.place(row)}{_hint(bare)}")


def _hint(text: str) -> str:
    """A likely cause of a cell that is not a number, or what to do about it."""
    if text.count(",") == 1 and text.replace(",", "").lstrip("+-").isdigit():
        return "; a decimal comma? write numbers with a point"
    if text[:4].isdigit() and (":" in text or text[4:5] == "-"):
        return "; a date? write times as seconds"
    return "; leave the cell empty where the value is missing"
