"""D4RL's HDF5 layout, v0 to v2 (Fu et al. 2020): one file with the rows of all episodes, one after another."""

import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
from jaxtyping import Bool, Float

from madoc.data.archives import opened, size_of
from madoc.data.dataset import Dataset, close_episodes, starts_after
from madoc.data.validation import LARGEST_DATASET, as_matrix, as_transitions, check_size, require_arrays, validate
from madoc.errors import MadocError
from madoc.tasks import Task

NAMES_HERE = {
    "observation": "observations",
    "action": "actions",
    "reward": "rewards",
    "next_observation": "next_observations",
    "terminated": "terminals",
    "truncated": "timeouts",
}
OPTIONAL = {"next_observations", "timeouts"}
ANT_WIDTH, ANT_STATE_WIDTH = 111, 27
"""Values of D4RL's Ant: 27 of state, then contact forces of 14 bodies, which mujoco-py 2.x left at zero."""


def recognises(path: Path) -> bool:
    """Whether the file begins like HDF5."""
    return path.is_file() and bool(h5py.is_hdf5(path))


def read(path: Path, task: Task, *, clip_actions: bool = False) -> Dataset:
    """Read a D4RL file. `terminals` terminate, `timeouts` truncate.

    Without `next_observations` (v0) the next row's observation takes their place, and the last row of every episode is
    dropped, as its successor was not recorded (D4RL's own `qlearning_dataset` pairs it with the next episode's first
    observation). The row before then ends its episode as truncated. Without any timeout, an episode is cut after every
    `task.max_episode_steps` rows, as in `qlearning_dataset`. An Ant of 111 values keeps the first 27; the other 84
    must be 0. Physics is legacy for names that end in -v0, -v1 or -v2, as D4RL's do, else unknown.
    """
    arrays = _read_arrays(path)
    has_next = "next_observations" in arrays
    names = NAMES_HERE if has_next else {**NAMES_HERE, "next_observation": "observations"}
    for name in {names["observation"], names["next_observation"]}:
        arrays[name] = _observation(arrays[name], name, task)
    transitions = as_transitions({"timeouts": np.zeros(len(arrays["terminals"])), **arrays}, names)
    terminated, truncated = np.asarray(transitions.terminated), np.asarray(transitions.truncated)
    if not truncated.any():
        truncated = count_time_limits(terminated, task.max_episode_steps)
        transitions = replace(transitions, truncated=truncated)
    if not has_next:
        transitions = replace(transitions, next_observation=np.roll(transitions.observation, -1, axis=0))
    starts = starts_after(terminated | truncated)
    physics = "legacy" if re.search(r"-v[012]$", path.stem) else "unknown"
    dataset = Dataset(close_episodes(transitions, starts), starts, task.name, physics, origin=str(path))
    dataset = validate(dataset, task, names, clip_actions=clip_actions)
    return dataset if has_next else _without_last_rows(dataset)


def count_time_limits(ends: Bool[np.ndarray, " rows"], limit: int) -> Bool[np.ndarray, " rows"]:
    """Rows that reach a time limit of `limit` rows since the last end (or time limit)."""
    rows, starts = np.arange(len(ends)), starts_after(ends)
    age = rows - starts[np.searchsorted(starts, rows, side="right") - 1] + 1
    return (age % limit == 0) & ~ends


def _without_last_rows(dataset: Dataset) -> Dataset:
    """Drop the last row of every episode; episodes of one row vanish."""
    rows = np.setdiff1d(np.arange(len(dataset)), dataset.episode_ends - 1)
    if not len(rows):
        raise MadocError(
            f"expected episodes of two rows or more, got {len(dataset)} of one row in {dataset.origin}; "
            "without next_observations they hold no transition, so record longer ones"
        )
    return dataset.take(rows, np.flatnonzero(np.diff(dataset.episode_of(rows), prepend=-1)))


def _observation(values: np.ndarray, name: str, task: Task) -> Float[np.ndarray, "rows observation"]:
    observation = as_matrix(values, name)
    if task.name != "ant" or observation.shape[1] != ANT_WIDTH:
        return observation
    forces = observation[:, ANT_STATE_WIDTH:]
    if forces.any():
        row, column = np.argwhere(forces)[0]
        raise MadocError(
            f"expected zeros after the first 27 values of an Ant of 111, got {forces[row, column]:g} in "
            f"row {row}, column {ANT_STATE_WIDTH + column} of {name}; contact forces are not part of this "
            "task, cut them off"
        )
    return np.ascontiguousarray(observation[:, :ANT_STATE_WIDTH])


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    with opened(path, "it is damaged, was cut short or has another format, copy or download it again") as file:
        present = [name for name in NAMES_HERE.values() if isinstance(file.get(name), h5py.Dataset)]
        check_size(sum(size_of(file[name]) for name in present), f"the arrays of {path}", LARGEST_DATASET)
        arrays = {name: np.atleast_1d(file[name][()]) for name in present}
    required = [name for name in NAMES_HERE.values() if name not in OPTIONAL]
    require_arrays(arrays, required, path, "if it is a Minari file, pass its directory instead")
    return arrays
