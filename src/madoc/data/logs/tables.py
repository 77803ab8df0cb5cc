"""The result of every reader of logs: runs, each with tables of named columns."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

from madoc.data.archives import Stored
from madoc.data.validation import LARGEST, check_size
from madoc.errors import MadocError

WIDEST = 1000
"""Number of values per row; an array with more is taken for a picture and not read."""

EPISODES = ("episode", "episode_id", "episode_index", "trial")
"""Names of columns, in lower case, whose value changes from one episode to the next."""
ENDS = ("terminals", "timeouts", "terminated", "truncated", "done", "is_last")
"""Names of columns, in lower case, that become 1 in the last row of an episode."""

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
        unread: Names of columns that nobody has asked for, which were not read.
    """

    columns: Mapping[str, np.ndarray]
    clock: str | None = None
    lines: Int[np.ndarray, " rows"] | None = None
    others: Mapping[str, str] = field(default_factory=dict)
    unread: Sequence[str] = ()

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
    def size(self) -> int:
        """Size of all columns in memory, bytes."""
        return sum(column.nbytes for table in self.tables for column in table.columns.values())

    @property
    def names(self) -> list[str]:
        """Names of all columns that can be read."""
        return list(dict.fromkeys(name for table in self.tables for name in (*table.columns, *table.unread)))


def is_asked(name: str, wanted: Collection[str]) -> bool:
    """Whether an array has to be read: it or an element of it is wanted, or it may tell where episodes begin or end."""
    return name.lower() in (*EPISODES, *ENDS) or any(one == name or one.startswith(f"{name}[") for one in wanted)


def asked_tables(arrays: Mapping[str, Stored], wanted: Collection[str], file: str) -> tuple[Table, ...]:
    """Tables of the arrays of a file that are wanted, the only ones that are read.

    Raises:
        MadocError: They are larger than `LARGEST`.
    """
    asked = {name: array for name, array in arrays.items() if is_asked(name, wanted)}
    others = {name: _unreadable(array.shape, array.dtype) for name, array in arrays.items()}
    readable = {name: array for name, array in asked.items() if not others[name]}
    check_size(sum(array.size for array in readable.values()), f"the columns of {file} that are asked for", LARGEST)
    unread = [
        element
        for name, array in arrays.items()
        if name not in asked and not others[name]
        for element in _element_names(name, array.shape)
    ]
    kinds = {name: what for name, what in others.items() if what}
    tables = tables_of({name: array.read() for name, array in readable.items()})
    return tuple(replace(table, others={**kinds, **table.others}, unread=unread) for table in tables)


def _element_names(name: str, shape: tuple[int, ...]) -> list[str]:
    """Names of the columns that an array becomes."""
    return [name] if len(shape) == 1 or shape[1] == 1 else [f"{name}[{index}]" for index in range(shape[1])]


def tables_of(arrays: Mapping[str, np.ndarray], *, clock: str | None = None) -> tuple[Table, ...]:
    """Arrays as tables, one for each length; a matrix becomes columns `name[0]`, `name[1]`, ...

    Scalars, pictures and objects are left out, but for their names.
    """
    grouped: dict[int, dict[str, np.ndarray]] = {}
    others: dict[str, str] = {}
    for name, array in arrays.items():
        what = _unreadable(array.shape, array.dtype)
        if what:
            others[name] = what
        elif array.ndim == 1 or array.shape[1] == 1:
            grouped.setdefault(len(array), {})[name] = array.reshape(-1)
        else:
            columns = zip(_element_names(name, array.shape), array.T, strict=True)
            grouped.setdefault(len(array), {}).update(columns)
    tables = (Table(values, clock if clock in values else None, others=others) for values in grouped.values() if values)
    return tuple(tables) or (Table({}, others=others),)


def _unreadable(shape: tuple[int, ...], dtype: np.dtype) -> str:
    """The kind of an array that is not numbers, flags, times or text by row; empty for others."""
    if not shape:
        return "a single value"
    if len(shape) > 2 or (len(shape) == 2 and shape[1] > WIDEST):
        return f"an array of shape {shape}"
    return "" if dtype.kind in "fiubMmUSO" else f"of type {dtype}"


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
    raise MadocError(
        f"expected a number in column {name!r} of {run}, got {shown!r} in {table.place(row)}{_hint(bare, row)}"
    )


def _hint(text: str, row: int) -> str:
    """A likely cause of a cell that is not a number, or what to do about it."""
    if text.count(",") == 1 and text.replace(",", "").lstrip("+-").isdigit():
        return "; a decimal comma? write numbers with a point"
    if text[:4].isdigit() and (":" in text or text[4:5] == "-"):
        return "; a date? write times as seconds"
    if not row:
        return "; a row of units below the header? delete it. Leave a cell empty where its value is missing"
    return "; leave the cell empty where the value is missing"
