"""CSV, TSV and similar files: a line of names, then one line for each row."""

import csv
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from madoc.data.logs.tables import MISSING, WIDEST, Run, Table
from madoc.data.validation import LARGEST, check_size
from madoc.errors import MadocError

SEPARATORS = (",", ";", "\t")


def read(path: Path, wanted: Collection[str]) -> list[Run]:
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
