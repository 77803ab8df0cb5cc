"""HDF5: a dataset is a column, or a matrix of several; numbered groups with equal names in them are runs."""

import re
from collections.abc import Collection
from functools import partial
from pathlib import Path

import h5py

from madoc.data.hdf5 import opened, read_values, size_of
from madoc.data.logs.tables import Run, Stored, asked_tables

_NUMBERED = re.compile(r".*\d+")


def read(path: Path, wanted: Collection[str]) -> list[Run]:
    """The runs of a file: its numbered groups (`demo_0`, `demo_1`, ...) where they hold equal names, else one.

    A dataset in a group is called by its path in the run: `obs/position[0]`.
    """
    with opened(path, "it is damaged or was cut short, copy or record it again") as file:
        return [
            Run(name, asked_tables(_arrays(group), wanted, name))
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


def _arrays(group: h5py.Group) -> dict[str, Stored]:
    """Datasets by name; none is read."""
    datasets = {name: group[name] for name in _names(group)}
    return {
        name: Stored(dataset.shape or (), dataset.dtype, size_of(dataset), partial(read_values, dataset))
        for name, dataset in datasets.items()
    }
