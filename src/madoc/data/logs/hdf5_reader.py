"""HDF5: a dataset is a column, or a matrix of several; numbered groups with equal names in them are runs."""

import re
from collections.abc import Collection
from pathlib import Path

import h5py
import numpy as np

from madoc.data.logs.tables import WIDEST, Run, tables_of
from madoc.errors import MadocError

_NUMBERED = re.compile(r".*\d+")


def read(path: Path, wanted: Collection[str]) -> list[Run]:
    """The runs of a file: its numbered groups (`demo_0`, `demo_1`, ...) where they hold equal names, else one.

    A dataset in a group is called by its path in the run: `obs/position[0]`.
    """
    try:
        with h5py.File(path, "r") as file:
            return [
                Run(f"{path.name}{group.name}" if numbered else path.name, tables_of(_arrays(group)))
                for group, numbered in _runs(file)
            ]
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        raise MadocError(
            f"cannot read {path.name} as HDF5 ({error}); it is damaged or was cut short, copy or record it again"
        ) from error


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


def _arrays(group: h5py.Group) -> dict[str, np.ndarray]:
    """Datasets by name; pictures are empty arrays of their shape."""
    arrays = {}
    for name in _names(group):
        dataset = group[name]
        picture = dataset.ndim > 2 or (dataset.ndim == 2 and dataset.shape[1] > WIDEST)
        arrays[name] = np.empty((0, *dataset.shape[1:])) if picture else np.asarray(dataset[()])
    return arrays
