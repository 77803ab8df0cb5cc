"""npz: an array is a column, a matrix is several."""

from collections.abc import Collection
from pathlib import Path

from madoc.data.logs.tables import Run, tables_of
from madoc.data.npz import read_arrays


def read(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run. The columns of a matrix `position` are `position[0]`, `position[1]`, ...

    Raises:
        MadocError: No npz, damaged, or holding Python objects.
    """
    return [Run(path.name, tables_of(read_arrays(path)))]
