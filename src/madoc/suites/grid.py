"""The entries of a suite file multiplied out: what each combination of a grid asks, and where every value stands."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Literal

from pydantic import Field

from madoc.errors import MadocError
from madoc.robots.document import Document, Part, Place, read_document, validated

GRID, ROBOTS, DATA = "grid", "robots", "data"
"""Keys of an entry that are no options: values to multiply out, and logs of several robots of one kind."""

RANGE = re.compile(r"\s*(-?\d{1,18})\s*\.\.\s*(-?\d{1,18})?\s*")
"""Whole numbers from the first to the last, as `0..4`."""
_LARGEST = 1_000_000
"""Largest number of combinations of one entry."""


class SuiteFile(Part):
    """A suite file: entries, each a cell or a grid of cells."""

    madoc: Literal[1] = Field(description="Version of this format.")
    cells: list[dict[str, object]] = Field(
        min_length=1, description="Entries: options of a calibration, and record, learn, evaluate, robots, grid."
    )


@dataclass(frozen=True)
class Combination:
    """One combination of an entry's grid.

    Attributes:
        given: Values by key.
        places: Where each stands in the file.
        entry: Position of the entry, from 0.
        robot: Name of the robot whose log it takes; empty where the entry does not name several.
    """

    given: Mapping[str, object]
    places: Mapping[str, Place]
    entry: int
    robot: str = ""


def read_suite(path: Path) -> tuple[SuiteFile, Document]:
    """A suite file and the lines of its parts.

    Raises:
        MadocError: There is no such file, or it has a mistake; the sentence names its line.
    """
    if not path.is_file():
        what = "is a directory" if path.is_dir() else "does not exist"
        raise MadocError(f"expected a suite file, as suite.yaml, got {path}, which {what}; see docs/how-to/cluster.md")
    document = read_document(
        path.read_bytes(), path.name, what="a suite file", remedy="write `madoc: 1` and a list of cells"
    )
    return validated(document, SuiteFile, "expected keys and values, `madoc: 1` and `cells:`"), document


def combinations(suite: SuiteFile, document: Document, folder: Path) -> Iterator[Combination]:
    """Every combination of every entry, in the order of the file; the last key of a grid changes fastest.

    The logs of robots are searched from the folder of the file.

    Raises:
        MadocError: A grid is empty or endless, or no log is found; the sentence names the line.
    """
    for index, entry in enumerate(suite.cells):
        yield from _of_entry(index, dict(entry), document, folder)


def _of_entry(index: int, entry: dict[str, object], document: Document, folder: Path) -> Iterator[Combination]:
    """The combinations of one entry."""
    at: Place = ("cells", index)
    grid = entry.pop(GRID, {})
    if not isinstance(grid, dict):
        raise document.error((*at, GRID), "expected keys with lists of values in grid, as `seed: 0..4`")
    if nested := next((key for key in (ROBOTS, GRID) if key in grid), None):
        raise document.error((*at, GRID, nested), f"{nested}: stands beside grid:, not in it")
    robots = _robots(entry.pop(ROBOTS), document, (*at, ROBOTS), folder) if ROBOTS in entry else {}
    if robots and (DATA in entry or DATA in grid):
        raise document.error((*at, ROBOTS), "robots: and data: both name logs; keep one")
    axes: list[list[tuple[str, object, Place, str]]] = []
    if robots:
        axes.append([(DATA, log, (*at, ROBOTS), name) for name, log in robots.items()])
    count = 1
    for key, values in grid.items():
        place = (*at, GRID, key)
        if key in entry:
            raise document.error(place, f"{key} is given here and again outside of grid; keep one")
        listed = _values(key, values, document, place)
        in_file = isinstance(values, list)
        axes.append([(key, value, (*place, n) if in_file else place, "") for n, value in enumerate(listed)])
        count *= len(listed)
        if count > _LARGEST:
            raise document.error(place, f"this grid has more than {_LARGEST:,} cells; make it smaller")
    fixed = {key: (*at, key) for key in entry}
    for chosen in product(*axes):
        yield Combination(
            given={**entry, **{key: value for key, value, _, _ in chosen}},
            places={**fixed, **{key: place for key, _, place, _ in chosen}, "": at},
            entry=index,
            robot=chosen[0][3] if robots else "",
        )


def _values(key: str, values: object, document: Document, place: Place) -> list[object]:
    """The values of one key of a grid: a list, or a range of whole numbers as `0..4`, both ends included."""
    if isinstance(values, str) and (ends := RANGE.fullmatch(values)):
        first = int(ends[1])
        if ends[2] is None:
            raise document.error(place, f"the range {values} of {key} has no end; write both, as {first}..{first + 4}")
        last = int(ends[2])
        if last < first:
            raise document.error(place, f"the range {values} of {key} ends before it begins")
        if last - first >= _LARGEST:
            raise document.error(place, f"the range {values} of {key} has more than {_LARGEST:,} values")
        return list(range(first, last + 1))
    if not isinstance(values, list):
        raise document.error(place, f"expected a list of values or a range as 0..4 for {key}, got {values!r:.60}")
    if not values:
        raise document.error(place, f"expected at least one value for {key}, got an empty list")
    return values


def _robots(value: object, document: Document, place: Place, folder: Path) -> dict[str, str]:
    """The logs of several robots, by a name that tells them apart; patterns as `arm-*` are looked up."""
    patterns = [value] if isinstance(value, str) else value
    if not isinstance(patterns, list) or not all(isinstance(pattern, str) for pattern in patterns):
        raise document.error(place, "expected a list of logs, one for each robot, as [arm-01, arm-02], or arm-*")
    found: list[str] = []
    for number, pattern in enumerate(patterns):
        where = (*place, number) if isinstance(value, list) else place
        try:
            logs = _matching(folder, pattern)
        except ValueError as error:
            sentence = f"{pattern} is no pattern of files; ** stands alone between slashes"
            raise document.error(where, sentence) from error
        if not logs:
            raise document.error(where, f"there is no file or folder {pattern}; each robot's logs are one")
        if twice := next((log for log in logs if log in found), None):
            raise document.error(where, f"the robot {twice} is named twice; keep one")
        found += logs
    if len(found) < 2:
        raise document.error(place, f"expected at least 2 robots, got {len(found)}; for one robot write data:")
    return dict(zip(_names(found), found, strict=True))


@lru_cache(maxsize=256)
def _matching(folder: Path, pattern: str) -> list[str]:
    """The files and folders that a pattern names, in the order of their names; hidden ones only where it says so."""
    path = Path(pattern).expanduser()
    if not any(mark in pattern for mark in "*?["):
        return [pattern] if (folder / path).exists() else []
    base = Path(path.anchor) if path.is_absolute() else folder
    found = base.glob(str(path.relative_to(path.anchor)))
    return sorted(str(match) for match in found if path.name.startswith(".") or not match.name.startswith("."))


def _names(logs: list[str]) -> list[str]:
    """What tells paths apart: each without the folders that all share at its beginning and at its end."""
    parts = [Path(log).parts for log in logs]
    first = _shared(parts)
    last = _shared([row[first:][::-1] for row in parts])
    return ["/".join(row[first : len(row) - last]) or log for row, log in zip(parts, logs, strict=True)]


def _shared(rows: list[tuple[str, ...]]) -> int:
    """How many of their first parts all rows have in common."""
    return next((n for n, column in enumerate(zip(*rows, strict=False)) if len(set(column)) > 1), min(map(len, rows)))
