"""Parquet; a column of lists becomes one column for each element."""

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from madoc.data.logs.tables import Run, tables_of
from madoc.errors import MadocError

if TYPE_CHECKING:
    import pyarrow


def read(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run. The elements of a list column `position` are the columns `position[0]`, ..."""
    return [Run(path.name, tables_of(read_columns(path)))]


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """Every column by name; columns that are not numbers, flags, times or text are empty."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MadocError(f'Parquet logs need pyarrow: pip install "madoc-calibration[logs]" ({error})') from error
    try:
        with path.open("rb") as file:
            opened = pyarrow.parquet.ParquetFile(file)
            readable = {field.name: _is_readable(field.type) for field in opened.schema_arrow}
            table = opened.read(columns=[name for name, used in readable.items() if used])
        return {
            name: _column(table.column(name), path) if used else np.zeros(0, dtype="V1")
            for name, used in readable.items()
        }
    except (pyarrow.ArrowException, OSError) as error:
        raise MadocError(
            f"cannot read {path.name} as Parquet ({' '.join(str(error).split())}); it is damaged or was cut short, "
            "copy or record it again"
        ) from error


def _is_readable(kind: "pyarrow.DataType") -> bool:
    from pyarrow import types

    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        return types.is_integer(kind.value_type) or types.is_floating(kind.value_type)
    numbers = (types.is_integer, types.is_floating, types.is_boolean, types.is_decimal, types.is_timestamp)
    return any(test(kind) for test in (*numbers, types.is_string, types.is_large_string))


def _column(column: "pyarrow.ChunkedArray", path: Path) -> np.ndarray:
    """One value per row, or for a column of lists one row of values; NaN where a row has none."""
    import pyarrow
    from pyarrow import compute, types

    if types.is_decimal(column.type):
        column = column.cast(pyarrow.float64())
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
