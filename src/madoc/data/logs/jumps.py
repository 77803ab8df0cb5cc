"""Jumps in a log that are no motion: of angles, of a quaternion's sign, between episodes, and runs that are copies."""

import hashlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from madoc.data.findings import Finding
from madoc.data.logs.tables import ENDS, EPISODES, MISSING, Run, Table
from madoc.data.logs.timing import Series

_WITHIN = 1.05
"""Span of an angle that wraps around, in turns; noise may bring it slightly above 1."""
_SLOW = 0.25
"""Median change of an angle from row to row, the shorter way round, in turns; above it either way may be meant."""
_TRUE = frozenset(("true", "t", "yes", "y", "on"))
_FALSE = frozenset(("false", "f", "no", "n", "off")) | MISSING


def unwrapped(
    series: Series, columns: Sequence[str], turns: Mapping[str, float]
) -> tuple[Float[np.ndarray, "rows columns"], list[Finding]]:
    """The values of a series, its angles made continuous where they wrap around, and a note on each.

    `turns` are the changes of angles in a turn, by column. An angle that covers more than a turn does not wrap around,
    and one that moves by a quarter of a turn from row to row may have gone either way round: both are left alone.
    """
    values, findings = series.values.copy(), []
    for index, column in enumerate(columns):
        turn, known = turns.get(column, 0.0), np.isfinite(values[:, index])
        angle = values[known, index]
        if not turn or len(angle) < 2 or np.ptp(angle) > _WITHIN * turn:
            continue
        change = np.diff(angle)
        count = int((np.abs(change) > turn / 2.0).sum())
        if count and np.median(np.abs(np.mod(change + turn / 2.0, turn) - turn / 2.0)) <= _SLOW * turn:
            values[known, index] = np.unwrap(angle, period=turn)
            what = f"column {column!r} jumps by a whole turn in {count:,} rows: it was unwrapped"
            findings.append(Finding("note", what, series.run, "a policy needs the unwrapped angle too"))
    return values, findings


def of_one_sign(
    series: Series, columns: Sequence[str], quaternions: Mapping[str, str]
) -> tuple[Float[np.ndarray, "rows columns"], list[Finding]]:
    """The values of a series, its quaternions made continuous where they change their sign, and a note on each.

    `quaternions` are the joints of whose quaternion columns are components. A quaternion and its negative are the same
    orientation, and trackers often log the one whose real part is positive. One without all four columns is left alone.
    """
    values, findings = series.values.copy(), []
    for joint in filter(None, dict.fromkeys(quaternions.values())):
        parts = [index for index, column in enumerate(columns) if quaternions.get(column) == joint]
        known = np.flatnonzero(np.isfinite(values[:, parts]).all(1))
        logged = values[:, parts][known]
        turned = (logged[1:] * logged[:-1]).sum(1) < 0.0
        if len(parts) == 4 and turned.any():
            sign = np.where(np.cumsum(turned) % 2, -1.0, 1.0)
            values[known[1:, None], parts] *= sign[:, None]
            what = f"the quaternion of {joint!r} changes its sign in {int(turned.sum()):,} rows: it was made continuous"
            findings.append(Finding("note", what, series.run, "a policy needs the continuous quaternion too"))
    return values, findings


def split_episodes(run: Run, used: Collection[str]) -> tuple[list[Run], list[Finding]]:
    """The episodes that a run's table says it holds, each as a run, and a note where there are several.

    What `EPISODES` and `ENDS` name counts unless it is `used` for a signal or an action. Episodes of one row are left
    out. A run whose signals and actions are in several tables, with a clock each, is not split.
    """
    tables = [table for table in run.tables if table.columns.keys() & set(used)]
    if len(tables) != 1:
        return [run], []
    (table,) = tables
    first = _first_rows(table, used)
    if len(first) < 2:
        return [run], []
    ends = np.append(first[1:], len(table))
    parts = [
        Run(f"{run.name}, episode {number}", (_rows_of(table, slice(start, end)),), run.timed)
        for number, (start, end) in enumerate(zip(first, ends, strict=True), 1)
        if end - start > 1
    ]
    if not parts:
        return [run], []
    short = len(first) - len(parts)
    what = f"it holds {len(first):,} episodes{f', of which {short:,} have one row and are left out' if short else ''}"
    return parts, [Finding("warning" if short else "note", what, run.name)]


def _first_rows(table: Table, used: Collection[str]) -> Int[np.ndarray, " episodes"]:
    """The first row of each episode."""
    begins = np.zeros(len(table), dtype=bool)
    begins[:1] = True
    for name in table.columns.keys() - set(used):
        values = table.columns[name]
        if name.lower() in EPISODES:
            number = _numbers(values)
            begins[1:] |= number[1:] != number[:-1]
        elif name.lower() in ENDS:
            ended = _numbers(values) > 0.0
            begins[2:] |= ended[1:-1] & ~ended[:-2]
            begins[1:2] |= ended[:1]
    return np.flatnonzero(begins)


def _numbers(values: np.ndarray) -> Float[np.ndarray, " rows"]:
    """Values as numbers: flags as 0 and 1, what is missing as 0, other text as numbers that differ where it does."""
    if values.dtype.kind in "fiub":
        return np.nan_to_num(values.astype(np.float64))
    texts, places = np.unique(values.astype(str), return_inverse=True)
    return np.array([_number(text, place) for place, text in enumerate(texts.tolist())])[places]


def _number(text: str, otherwise: int) -> float:
    word = text.strip().removeprefix("b'").removesuffix("'").lower()
    if word in _FALSE or word in _TRUE:
        return float(word in _TRUE)
    try:
        return float(np.nan_to_num(float(word)))
    except ValueError:
        return float(otherwise + 1)


def _rows_of(table: Table, rows: slice) -> Table:
    """Some rows of a table."""
    columns = {name: values[rows] for name, values in table.columns.items()}
    return replace(table, columns=columns, lines=None if table.lines is None else table.lines[rows])


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
