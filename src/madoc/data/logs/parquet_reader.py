"""Parquet: each column is a column; a column of lists becomes one column for each element."""

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from madoc.data.logs.tables import Run, tables_of
from madoc.errors import MadocError

if TYPE_CHECKING:
    import pyarrow


def read(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run. The elements of a list column `position` are the columns `position[0]`, ...

    Raises:
        MadocError: pyarrow is missing, no Parquet, damaged, or rows of a list column of unequal lengths.
    """
    return [Run(path.name, tables_of(read_columns(path)))]


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """Every column by name; columns that are not numbers, flags, times or text are empty.

    Raises:
        MadocError: As `read`.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MadocError(f'Parquet logs need pyarrow: pip install "madoc-calibration[logs]" ({error})') from error
    try:
        with path.open("rb") as file:
            opened = pyarrow.parquet.ParquetFile(file)
            names = [field.name for field in opened.schema_arrow if _is_readable(field.type)]
            table = opened.read(columns=names)
            others = [name for name in opened.schema_arrow.names if name not in names]
        columns = {name: _column(table.column(name).combine_chunks(), path) for name in names}
    except (pyarrow.ArrowException, OSError) as error:
        raise MadocError(
            f"cannot read {path.name} as Parquet ({_first_line(error)}); it is damaged or was cut short, copy or "
            "record it again"
        ) from error
    return columns | {name: np.zeros(0, dtype="V1") for name in others}


def _is_readable(kind: "pyarrow.DataType") -> bool:
    from pyarrow import types

    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        return types.is_integer(kind.value_type) or types.is_floating(kind.value_type)
    readable = (types.is_integer, types.is_floating, types.is_boolean, types.is_string, types.is_large_string)
    return types.is_decimal(kind) or types.is_timestamp(kind) or any(test(kind) for test in readable)


def _column(column: "pyarrow.Array | pyarrow.ChunkedArray", path: Path) -> np.ndarray:
    import pyarrow
    from pyarrow import types

    column = column if isinstance(column, pyarrow.Array) else pyarrow.concat_arrays(column.chunks)
    if types.is_decimal(column.type):
        column = column.cast(pyarrow.float64())
    if not types.is_nested(column.type):
        return np.asarray(column.to_numpy(zero_copy_only=False))
    fixed = types.is_fixed_size_list(column.type)
    lengths = set() if fixed else set(column.drop_null().value_lengths().to_pylist())
    if len(lengths) > 1:
        raise MadocError(
            f"expected as many values in every row of a list column of {path.name}, got {min(lengths)} and "
            f"{max(lengths)}; pad it, or leave the column out"
        )
    if column.null_count:
        rows = column.to_pylist()
        width = next((len(row) for row in rows if row is not None), 0)
        return np.array([[np.nan] * width if row is None else row for row in rows], dtype=np.float64)
    return np.asarray(column.flatten().to_numpy(zero_copy_only=False)).reshape(len(column), -1)


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
