"""Files of columns as logs: CSV and the like (a line of names, then one line for each row), npz, HDF5 and Minari."""

import csv
import re
from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path

import h5py
import jax
import numpy as np

from madoc.data.archives import Stored, opened, read_values, require_npz, size_of, stored_in_npz
from madoc.data.logs.tables import MISSING, WIDEST, Run, Table, asked_tables, tables_of
from madoc.data.minari_reader import local_directory, read_episodes
from madoc.data.validation import LARGEST, check_size
from madoc.errors import MadocError

SEPARATORS = (",", ";", "\t")
_NUMBERED = re.compile(r".*\d+")


def read_csv(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run. A comma, semicolon or tab separates, whichever the header has most of; `#` begins a comment.

    A header may itself begin with `#`, as NumPy writes it. Cells stay text where not all of the file is numbers. Cells
    that are lists, as "[0.1, 0.2]" or "[0.1 0.2]" in a column `position`, are the columns `position[0]`, `position[1]`.
    """
    check_size(path.stat().st_size, f"the text of {path.name}", LARGEST)
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = list(file)
        names, separator, first = _header(lines, path)
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise MadocError(f"expected each column of {path.name} named once, got {twice!r} twice; rename one of them")
        table = _all_numbers(lines, names, separator, first) or _cells(lines, names, separator, first, path)
    except UnicodeDecodeError as error:
        raise MadocError(f"{path.name} is not text in UTF-8 ({error.reason}); save it as CSV again") from error
    except csv.Error as error:
        raise MadocError(f"cannot read {path.name} as CSV ({error}); save it as CSV again") from error
    return [Run(path.name, (table,))]


def _header(lines: Sequence[str], path: Path) -> tuple[list[str], str, int]:
    """Names, the separator, and the line after the header, counted from 0."""
    comment = ""
    for line, text in enumerate(lines):
        bare = text.strip()
        if not bare:
            continue
        if bare.startswith("#"):
            comment = bare.lstrip("# ")
            continue
        separator = max(SEPARATORS, key=bare.count)
        cells = _split(bare, separator)
        if not any(map(_is_number, cells)):
            return cells, separator, line + 1
        names = _split(comment, max(SEPARATORS, key=comment.count)) if comment else []
        if len(names) == len(cells):
            return names, separator, line
        raise MadocError(
            f"expected the names of the columns in the first line of {path.name}, got {bare[:40]!r}; add a header"
        )
    raise MadocError(f"expected a header and rows in {path.name}, got no line with anything in it; record it again")


def _split(line: str, separator: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _all_numbers(lines: Sequence[str], names: list[str], separator: str, first: int) -> Table | None:
    """The table of a file that has only numbers, read by NumPy; None for others, and for files without rows."""
    rows = [row for row in range(first, len(lines)) if (bare := lines[row].strip()) and not bare.startswith("#")]
    if not rows:
        return None
    try:
        values = np.loadtxt([lines[row] for row in rows], delimiter=separator, ndmin=2, quotechar='"')
    except ValueError:
        return None
    if values.shape != (len(rows), len(names)):
        return None
    return Table(dict(zip(names, np.ascontiguousarray(values.T), strict=True)), lines=1 + np.array(rows))


def _cells(lines: Sequence[str], names: list[str], separator: str, first: int, path: Path) -> Table:
    """Cells as text."""
    rows: dict[int, list[str]] = {}
    reader, line = csv.reader(lines, delimiter=separator), 0
    for cells in reader:
        before, line = line, reader.line_num
        if line > before + 1:
            raise MadocError(
                f"expected every row of {path.name} on a line of its own, got a quotation mark that opens in line "
                f"{before + 1} and is not closed there; close it, or leave that column out"
            )
        empty = not any(cell.strip() for cell in cells)
        if line <= first or empty or cells[0].lstrip().startswith("#"):
            continue
        if len(cells) != len(names):
            raise MadocError(
                f"expected {len(names)} cells in every line of {path.name}, as in its header, got {len(cells)} in "
                f"line {line}; was the file cut short there?"
            )
        rows[line] = cells
    if not rows:
        raise MadocError(f"expected rows below the header of {path.name}, got none; record it again")
    columns: dict[str, np.ndarray] = {}
    for name, column in zip(names, zip(*rows.values(), strict=True), strict=True):
        columns |= _elements(name, column, list(rows), path)
    return Table(columns, lines=np.array(list(rows)))


def _elements(name: str, cells: Sequence[str], lines: Sequence[int], path: Path) -> dict[str, np.ndarray]:
    """A column by its name, or the columns of its elements where its cells are lists; a missing list lacks them all."""
    bare = [cell.strip() for cell in cells]
    lists = [None if cell.lower() in MISSING else cell[1:-1].replace(",", " ").split() for cell in bare]
    lengths = {len(values): line for values, line in zip(lists, lines, strict=True) if values is not None}
    listed = all(values is None or (cell[0], cell[-1]) == ("[", "]") for cell, values in zip(bare, lists, strict=True))
    if not lengths or not listed or max(lengths) > WIDEST:
        return {name: np.array(cells, dtype=object)}
    if len(lengths) > 1:
        few, many = min(lengths), max(lengths)
        raise MadocError(
            f"expected as many values in every list of column {name!r} of {path.name}, got {few} in line "
            f"{lengths[few]} and {many} in line {lengths[many]}; pad them, or leave the column out"
        )
    (length,) = lengths
    table = np.array([[""] * length if values is None else values for values in lists], dtype=object)
    return {f"{name}[{index}]": table[:, index] for index in range(length)}


def read_npz(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run; an array is a column, or a matrix of several."""
    require_npz(path)
    return [Run(path.name, asked_tables(stored_in_npz(path), wanted, path.name))]


def read_hdf5(path: Path, wanted: Collection[str]) -> list[Run]:
    """The runs of a file: its numbered groups (`demo_0`, `demo_1`, ...) where they hold equal names, else one.

    A dataset is a column, or a matrix of several. One in a group is called by its path in the run: `obs/position[0]`.
    """
    with opened(path, "it is damaged or was cut short, copy or record it again") as file:
        return [
            Run(name, asked_tables(_stored(group), wanted, name))
            for group, numbered in _runs(file)
            for name in [f"{path.name}{group.name}" if numbered else path.name]
        ]


def _runs(file: h5py.File) -> list[tuple[h5py.Group, bool]]:
    """The groups that are runs, or the whole file, and whether they are numbered groups."""
    group: h5py.Group = file
    while True:
        children = [child for child in group.values() if isinstance(child, h5py.Group)]
        alike = [child for child in children if _NUMBERED.fullmatch(child.name.rsplit("/", 1)[-1])]
        if alike and len(alike) == len(group) and len({frozenset(_names(child)) for child in alike}) == 1:
            return [(child, True) for child in sorted(alike, key=_by_number)]
        if len(children) != 1 or len(group) != 1:
            return [(file, False)]
        (group,) = children


def _by_number(group: h5py.Group) -> tuple[int, str]:
    return int(re.findall(r"\d+", group.name)[-1]), group.name


def _names(group: h5py.Group) -> list[str]:
    names: list[str] = []
    group.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    return names


def _stored(group: h5py.Group) -> dict[str, Stored]:
    """Datasets by name; none is read."""
    datasets = {name: group[name] for name in _names(group)}
    return {
        name: Stored(dataset.shape or (), dataset.dtype, size_of(dataset), partial(read_values, dataset))
        for name, dataset in datasets.items()
    }


def read_minari(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run for each episode, with columns `observations[0]`, `actions[0]`, ...; or `observations/key[0]`, ....

    The last row of an episode has an observation and no action.
    """
    episodes, _ = read_episodes(local_directory(path))
    return [
        Run(
            f"{path.name}/episode_{episode.id}",
            tables_of(_leaves("observations", episode.observations) | _leaves("actions", episode.actions, padded=True)),
            timed=False,
        )
        for episode in episodes
    ]


def _leaves(name: str, values: object, *, padded: bool = False) -> dict[str, np.ndarray]:
    """The arrays in dictionaries and tuples, by path; a row of NaN is added to padded ones."""
    leaves = jax.tree_util.tree_leaves_with_path(
        {name: values}, is_leaf=lambda part: not isinstance(part, dict | tuple)
    )
    arrays = {jax.tree_util.keystr(path, simple=True, separator="/"): np.asarray(leaf) for path, leaf in leaves}
    for path, array in arrays.items():
        if padded and array.dtype.kind in "fiub":
            arrays[path] = np.concatenate([array.astype(np.float64), np.full((1, *array.shape[1:]), np.nan)])
    return arrays
