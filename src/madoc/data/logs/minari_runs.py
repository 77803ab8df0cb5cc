"""Minari datasets as logs: one run for each episode, without times."""

from collections.abc import Collection
from pathlib import Path

import numpy as np

from madoc.data.logs.tables import Run, tables_of
from madoc.data.minari_reader import local_directory, read_episodes


def read(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run for each episode, with columns `observations[0]`, `actions[0]`, ...; or `observations/key[0]`, ....

    The last row of an episode has an observation and no action.

    Raises:
        MadocError: Minari is not installed, or the dataset is damaged.
    """
    episodes, _ = read_episodes(local_directory(path))
    return [
        Run(
            f"{path.name}/episode_{episode.id}",
            tables_of(_flat("observations", episode.observations) | _flat("actions", episode.actions, padded=True)),
            timed=False,
        )
        for episode in episodes
    ]


def _flat(name: str, values: object, *, padded: bool = False) -> dict[str, np.ndarray]:
    if isinstance(values, dict):
        parts = (_flat(f"{name}/{key}", value, padded=padded) for key, value in values.items())
    elif isinstance(values, tuple):
        parts = (_flat(f"{name}/{index}", value, padded=padded) for index, value in enumerate(values))
    else:
        array = np.asarray(values)
        if padded and array.dtype.kind in "fiub":
            array = np.concatenate([array.astype(np.float64), np.full((1, *array.shape[1:]), np.nan)])
        return {name: array}
    return {key: value for part in parts for key, value in part.items()}
