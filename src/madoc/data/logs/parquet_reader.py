"""Parquet: a column a column; a list a row becomes several."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from madoc.data.logs.tables import Run, tables_of
from madoc.errors import MadocError


def read(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run. Elements of a list column `position` are `position[0]`, ...

    Raises:
        MadocError: pyarrow is missing, no Parquet, damaged, or rows of a list column of unequal lengths.
    """
    return [Run(path.name, tables_of(read_columns(path)))]


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """Every column by name; of pictures, structures and the like only that they are there.

    Raises:
        MadocError: As `read`.
    """
    pyarrow, parquet = _import_pyarrow()
    try:
        with path.open("rb") as file:
            opened = parquet.ParquetFile(file)
            names = [field.name for field in opened.schema_arrow if _is_readable(pyarrow, field.type)]
            table = opened.read(columns=names)
            others = [name for name in opened.schema_arrow.names if name not in names]
        columns = {name: _column(pyarrow, table.column(name), path) for name in names}
    except (pyarrow.ArrowException, OSError) as error:
        raise MadocError(
            f"cannot read {path.name} as Parquet ({_first_line(error)}); it is damaged or was cut short, copy or "
            "record it again"
        ) from error
    return columns | {name: np.zeros(0, dtype="V1") for name in others}


def _import_pyarrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MadocError(f'Parquet logs need pyarrow: pip install "madoc-calibration[logs]" ({error})') from error
    return pyarrow, pyarrow.parquet


def _is_readable(pyarrow: Any, kind: Any) -> bool:
    types = pyarrow.types
    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        return types.is_integer(kind.value_type) or types.is_floating(kind.value_type)
    readable = (types.is_integer, types.is_floating, types.is_boolean, types.is_string, types.is_large_string)
    return types.is_decimal(kind) or types.is_timestamp(kind) or any(test(kind) for test in readable)


def _column(pyarrow: Any, chunks: Any, path: Path) -> np.ndarray:
    column, types = chunks.combine_chunks(), pyarrow.types
    column = column if isinstance(column, pyarrow.Array) else pyarrow.concat_arrays(column.chunks)
    if types.is_decimal(column.type):
        column = column.cast(pyarrow.float64())
    if not types.is_nested(column.type):
        return np.asarray(column.to_numpy(zero_copy_only=False))
    lengths = set(column.drop_null().value_lengths().to_pylist()) if not _fixed(pyarrow, column) else set()
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


def _fixed(pyarrow: Any, column: Any) -> bool:
    return bool(pyarrow.types.is_fixed_size_list(column.type))


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
