"""Minari datasets as logs: one run for each episode, without times."""

from collections.abc import Collection
from pathlib import Path

import jax
import numpy as np

from madoc.data.logs.tables import Run, tables_of
from madoc.data.minari_reader import local_directory, read_episodes


def read(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run for each episode, with columns `observations[0]`, `actions[0]`, ...; or `observations/key[0]`, ....

    The last row of an episode has an observation and no action.
    """
    episodes, _ = read_episodes(local_directory(path))
    return [
        Run(
            f"{path.name}/episode_{episode.id}",
            tables_of(_arrays("observations", episode.observations) | _arrays("actions", episode.actions, padded=True)),
            timed=False,
        )
        for episode in episodes
    ]


def _arrays(name: str, values: object, *, padded: bool = False) -> dict[str, np.ndarray]:
    """The arrays in dictionaries and tuples, by path; a row of NaN is added to padded ones."""
    leaves = jax.tree_util.tree_leaves_with_path(
        {name: values}, is_leaf=lambda part: not isinstance(part, dict | tuple)
    )
    arrays = {jax.tree_util.keystr(path, simple=True, separator="/"): np.asarray(leaf) for path, leaf in leaves}
    for path, array in arrays.items():
        if padded and array.dtype.kind in "fiub":
            arrays[path] = np.concatenate([array.astype(np.float64), np.full((1, *array.shape[1:]), np.nan)])
    return arrays
