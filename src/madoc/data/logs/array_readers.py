"""Files of arrays as logs: npz, HDF5 and Minari datasets."""

import re
from collections.abc import Collection
from functools import partial
from pathlib import Path

import h5py
import jax
import numpy as np

from madoc.data.archives import Stored, opened, read_values, require_npz, size_of, stored_in_npz
from madoc.data.logs.tables import Run, asked_tables, tables_of
from madoc.data.minari_reader import local_directory, read_episodes

_NUMBERED = re.compile(r".*\d+")


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
