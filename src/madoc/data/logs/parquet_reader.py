"""Parquet, and LeRobot's datasets of it; a column of lists becomes one column for each element."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from madoc.data.logs.tables import Run, is_asked, tables_of
from madoc.data.validation import LARGEST, LARGEST_OF_ALL, check_size, require_file
from madoc.errors import MadocError, needing
from madoc.runs.files import read_json

_ROWS = 20_000
"""Rows that are read at a time."""

if TYPE_CHECKING:
    import pyarrow
    import pyarrow.parquet

CLOCK = "timestamp"


def read(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run. The elements of a list column `position` are the columns `position[0]`, ..."""
    columns, unread = read_columns(path, wanted)
    return [Run(path.name, tuple(replace(table, unread=unread) for table in tables_of(columns)))]


def read_columns(path: Path, wanted: Collection[str]) -> tuple[dict[str, np.ndarray], list[str]]:
    """The wanted columns by name, and the names of those that were not read.

    Columns that are not numbers, flags, times or text are empty.

    Raises:
        MadocError: The file is damaged, or the wanted columns are larger than `LARGEST`.
    """
    with needing("Parquet logs need pyarrow:", "madoc-calibration[logs]"):
        import pyarrow
        import pyarrow.parquet
    try:
        with path.open("rb") as file:
            schema = pyarrow.parquet.read_schema(file)
            kinds = {field.name: field.type for field in schema}
            asked = [name for name in kinds if is_asked(name, wanted)]
            used = [name for name in asked if _is_readable(kinds[name])]
            texts = [name for name in used if _is_text(kinds[name])]
            opened = pyarrow.parquet.ParquetFile(file, read_dictionary=texts)  # which holds each text once
            what = f"the columns of {path.name} that are asked for"
            check_size(opened.metadata.num_rows * sum(_width(kinds[name]) for name in used), what, LARGEST)
            lists = any(_is_of_any_length(kinds[name]) for name in used)
            table = _read_in_parts(opened, used, what) if lists else opened.read(columns=used)
        check_size(sum(_size_of_text(table.column(name)) for name in texts), what, LARGEST)
        columns = {
            name: _column(table.column(name), path) if name in used else np.zeros(0, dtype="V1") for name in asked
        }
    except MadocError:
        raise
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        raise MadocError(
            f"cannot read {path.name} as Parquet ({' '.join(str(error).split())}); it is damaged or was cut short, "
            "copy or record it again"
        ) from error
    return columns, [name for name in kinds if name not in columns and _is_readable(kinds[name])]


def _width(kind: "pyarrow.DataType") -> int:
    """Size in memory of a row of a column, bytes; of a list of any length, that of one element."""
    from pyarrow import types

    return 8 * (kind.list_size if types.is_fixed_size_list(kind) else 1)


def _is_of_any_length(kind: "pyarrow.DataType") -> bool:
    from pyarrow import types

    return bool(types.is_list(kind) or types.is_large_list(kind))


def _read_in_parts(file: "pyarrow.parquet.ParquetFile", names: Sequence[str], what: str) -> "pyarrow.Table":
    """Columns of a file, whose size is looked at after each part, as it does not say how long lists are."""
    import pyarrow

    parts, size = [], 0
    for part in file.iter_batches(_ROWS, columns=names):
        parts.append(part)
        size += part.nbytes
        check_size(size, what, LARGEST)
    schema = pyarrow.schema([file.schema_arrow.field(name) for name in names])
    return pyarrow.Table.from_batches(parts, schema if not parts else None)


def _size_of_text(column: "pyarrow.ChunkedArray") -> int:
    """Size in memory of text in bytes, which was read as places in a dictionary."""
    from pyarrow import compute

    longest = [compute.max(compute.binary_length(part.dictionary)).as_py() or 0 for part in column.chunks]
    return sum(len(part) * length for part, length in zip(column.chunks, longest, strict=True))


def _is_readable(kind: "pyarrow.DataType") -> bool:
    from pyarrow import types

    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        return types.is_integer(kind.value_type) or types.is_floating(kind.value_type)
    numbers = (types.is_integer, types.is_floating, types.is_boolean, types.is_decimal, types.is_timestamp)
    return _is_text(kind) or any(test(kind) for test in numbers)


def _is_text(kind: "pyarrow.DataType") -> bool:
    from pyarrow import types

    return bool(types.is_string(kind) or types.is_large_string(kind))


def _column(column: "pyarrow.ChunkedArray", path: Path) -> np.ndarray:
    """One value per row, or for a column of lists one row of values; NaN where a row has none."""
    import pyarrow
    from pyarrow import compute, types

    if types.is_decimal(column.type):
        column = column.cast(pyarrow.float64())
    if types.is_dictionary(column.type):
        column = column.cast(pyarrow.string())
    if not types.is_nested(column.type):
        return np.asarray(column.to_numpy())
    lengths = compute.unique(compute.list_value_length(column.drop_null())).to_pylist() or [0]
    if len(lengths) > 1:
        raise MadocError(
            f"expected as many values in every row of a list column of {path.name}, got {min(lengths)} and "
            f"{max(lengths)}; pad it, or leave the column out"
        )
    if column.null_count:
        rows = [[np.nan] * lengths[0] if row is None else row for row in column.to_pylist()]
        return np.array(rows, dtype=np.float64)
    return np.asarray(compute.list_flatten(column).to_numpy()).reshape(len(column), lengths[0])


def is_lerobot(path: Path) -> bool:
    """Whether a folder is such a dataset."""
    return (path / "meta" / "info.json").is_file()


def read_lerobot(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run for each episode. Elements of `observation.state` are `observation.state[0]`, ...

    Where meta/info.json names them, they are `observation.state[shoulder]` as well.
    """
    about = read_json(path / "meta" / "info.json")
    features = about.get("features") if isinstance(about, dict) else None
    files = sorted((path / "data").rglob("*.parquet"))
    if not isinstance(features, dict) or not files:
        what = "no features in meta/info.json" if files else "no Parquet file in its folder data"
        raise MadocError(f"{path.name} is no whole LeRobot dataset: {what}; download or record it again")
    episodes: dict[int, list[dict[str, np.ndarray]]] = {}
    unread: list[str] = []
    size = 0
    for file in files:
        require_file(file)
        columns, unread = read_columns(file, {*wanted, CLOCK})
        size += sum(values.nbytes for values in columns.values())
        check_size(size, f"the columns of {path.name} that are asked for", LARGEST_OF_ALL)
        if "episode_index" not in columns:
            raise MadocError(f"no column episode_index in {path.name}/{file.relative_to(path)}; is it of this dataset?")
        index = columns["episode_index"]
        for episode in np.unique(index):
            chosen = np.flatnonzero(index == episode)
            part = {name: values[chosen] for name, values in columns.items() if len(values) == len(index)}
            episodes.setdefault(int(episode), []).append(part)
    return [_run(path, episode, parts, features, unread) for episode, parts in sorted(episodes.items())]


def _run(
    path: Path,
    episode: int,
    parts: list[dict[str, np.ndarray]],
    features: Mapping[str, object],
    unread: Sequence[str],
) -> Run:
    """The run of an episode, of the parts of it that files have."""
    shared = [name for name in parts[0] if all(name in part for part in parts)]
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in shared}
    named = {
        f"{name}[{element}]": column
        for name, values in arrays.items()
        if len(elements := _element_names(features.get(name))) == values.shape[-1] and values.ndim == 2
        for element, column in zip(elements, values.T, strict=True)
    }
    tables = tables_of(arrays | named, clock=CLOCK)
    return Run(f"{path.name}/episode_{episode}", tuple(replace(table, unread=unread) for table in tables))


def _element_names(feature: object) -> list[str]:
    """Names of a feature's elements: a list, or one in a dictionary (`{"motors": [...]}`)."""
    names = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(names, dict):
        names = next(iter(names.values()), None)
    return [str(name) for name in names] if isinstance(names, list) else []
