"""Jumps in a log that are no motion: angles that wrap around, episodes in one table, and runs that are there twice."""

import hashlib
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.data.findings import Finding
from madoc.data.logs.tables import Run, Table
from madoc.data.logs.timing import Series

EPISODES = ("episode", "episode_id", "episode_index", "trial")
"""Names of columns, in lower case, whose value changes from one episode to the next."""
ENDS = ("terminals", "timeouts", "terminated", "truncated", "done", "is_last")
"""Names of columns, in lower case, that are 1 in the last row of an episode."""
_NEAR_A_TURN = 0.1
"""Largest difference of a jump from a whole turn, in turns."""
_SLOW = 0.1
"""Median change of an angle from row to row in turns; above it a jump may be motion."""
_FALSE = frozenset((b"0", b"false", b"", b"0.0", b"no"))


def unwrapped(
    series: Series, columns: Sequence[str], turns: Mapping[str, float]
) -> tuple[Float[np.ndarray, "rows columns"], list[Finding]]:
    """The values of a series, its angles made continuous where they jump by a whole turn, and a note on each.

    `turns` are the changes of angles in a turn, by column.
    """
    values, findings = series.values.copy(), []
    for index, column in enumerate(columns):
        turn, known = turns.get(column, 0.0), np.isfinite(values[:, index])
        change = np.abs(np.diff(values[known, index]))
        if not turn or not len(change) or np.median(change) > _SLOW * turn:
            continue
        count = int((np.abs(change - turn) < _NEAR_A_TURN * turn).sum())
        if count:
            values[known, index] = np.unwrap(values[known, index], period=turn)
            what = f"column {column!r} jumps by a whole turn in {count:,} rows: it was unwrapped"
            findings.append(Finding("note", what, series.run, "a policy needs the unwrapped angle too"))
    return values, findings


def episodes_of(table: Table, used: Collection[str], rows: Int[np.ndarray, " rows"]) -> Int[np.ndarray, " rows"]:
    """The episode of each of the rows, counted from 0, by columns that are not `used` for a signal or an action."""
    begins = np.zeros(len(rows), dtype=bool)
    for name in table.columns.keys() - set(used):
        values = table.columns[name][rows]
        if name.lower() in EPISODES:
            begins[1:] |= values[1:] != values[:-1]
        elif name.lower() in ENDS:
            begins[1:] |= _flags(values)[:-1]
    return np.cumsum(begins)


def _flags(values: np.ndarray) -> Bool[np.ndarray, " rows"]:
    """Whether flags are set, which may be numbers or text."""
    if values.dtype.kind in "fiub":
        return values.astype(np.float64) > 0.0
    return np.array([str(value).strip().lower().encode() not in _FALSE for value in values])


def without_copies(runs: Sequence[Run], wanted: Sequence[str]) -> tuple[list[Run], list[Finding]]:
    """The runs without those that hold the same rows as one before them, and a warning on each of these."""
    seen: dict[str, str] = {}
    kept, findings = [], []
    for run in runs:
        first = seen.setdefault(_digest(run, wanted), run.name)
        if first == run.name:
            kept.append(run)
        else:
            what = f"it holds the same rows as {first} and is left out"
            findings.append(Finding("warning", what, run.name, "nothing if it is a copy"))
    return kept, findings


def _digest(run: Run, wanted: Sequence[str]) -> str:
    """A number that is the same for runs whose columns hold the same."""
    digest = hashlib.blake2b()
    for table in run.tables:
        for name in wanted:
            if name in table.columns:
                values = table.columns[name]
                text = values.dtype.kind == "O"
                digest.update("\n".join(map(str, values)).encode() if text else np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()
