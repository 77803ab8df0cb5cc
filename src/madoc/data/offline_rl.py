"""Data sets of offline reinforcement learning: the files of D4RL and of NeoRL.

D4RL's HDF5 layout, v0 to v2 (Fu et al. 2020), is one file with the rows of all episodes, one after another. NeoRL's npz
layout (Qin et al. 2022) has `obs` with root positions, and one `done` for falls and time limits.
"""

import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.data.archives import holds, opened, read_arrays, size_of
from madoc.data.dataset import Dataset, close_episodes, starts_after
from madoc.data.validation import (
    LARGEST_DATASET,
    NAMES,
    as_matrix,
    as_transitions,
    as_vector,
    check_size,
    require_arrays,
    validate,
)
from madoc.errors import MadocError
from madoc.tasks import Task

D4RL_NAMES = {
    "observation": "observations",
    "action": "actions",
    "reward": "rewards",
    "next_observation": "next_observations",
    "terminated": "terminals",
    "truncated": "timeouts",
}
D4RL_OPTIONAL = {"next_observations", "timeouts"}
ANT_WIDTH, ANT_STATE_WIDTH = 111, 27
"""Values of D4RL's Ant: 27 of state, then contact forces of 14 bodies, which mujoco-py 2.x left at zero."""

NEORL_NAMES = {
    **NAMES,
    "observation": "obs",
    "next_observation": "next_obs",
    "terminated": "done",
    "truncated": "done",
}


def is_d4rl(path: Path) -> bool:
    """Whether the file begins like HDF5."""
    return path.is_file() and bool(h5py.is_hdf5(path))


def read_d4rl(path: Path, task: Task, *, clip_actions: bool = False) -> Dataset:
    """Read a D4RL file. `terminals` terminate, `timeouts` truncate.

    Without `next_observations` (v0) the next row's observation takes their place, and the last row of every episode is
    dropped, as its successor was not recorded (D4RL's own `qlearning_dataset` pairs it with the next episode's first
    observation). The row before then ends its episode as truncated. Without any timeout, an episode is cut after every
    `task.max_episode_steps` rows, as in `qlearning_dataset`. An Ant of 111 values keeps the first 27; the other 84
    must be 0. Physics is legacy for names that end in -v0, -v1 or -v2, as D4RL's do, else unknown.
    """
    arrays = _read_arrays(path)
    has_next = "next_observations" in arrays
    names = D4RL_NAMES if has_next else {**D4RL_NAMES, "next_observation": "observations"}
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
        present = [name for name in D4RL_NAMES.values() if isinstance(file.get(name), h5py.Dataset)]
        check_size(sum(size_of(file[name]) for name in present), f"the arrays of {path}", LARGEST_DATASET)
        arrays = {name: np.atleast_1d(file[name][()]) for name in present}
    required = [name for name in D4RL_NAMES.values() if name not in D4RL_OPTIONAL]
    require_arrays(arrays, required, path, "if it is a Minari file, pass its directory instead")
    return arrays


def is_neorl(path: Path) -> bool:
    """Whether the file is an npz with `obs` and `next_obs`."""
    return holds(path, "obs", "next_obs")


def read_neorl(path: Path, task: Task, *, clip_actions: bool = False) -> Dataset:
    """Read a NeoRL file. Its leading root positions, which never enter the dynamics, are dropped.

    `done` marks falls and time limits alike: it terminates where the task ends at the state rebuilt from
    `next_obs`, and truncates elsewhere. `index` holds episode ends in NeoRL's files and episode starts in
    what its package returns (`neorl/utils.py` puts a 0 in front); both are read. Physics is legacy: NeoRL
    used mujoco-py.
    """
    arrays = read_arrays(path)
    require_arrays(arrays, (*NEORL_NAMES.values(), "index"), path, "pass the --format it has")
    for name in ("obs", "next_obs"):
        arrays[name] = _without_root(arrays[name], name, task)
    transitions = as_transitions(arrays, NEORL_NAMES)
    done = np.asarray(transitions.terminated)
    terminated = done & np.asarray(task.terminated(_rebuild(arrays["next_obs"], task)), dtype=bool)
    starts = _episode_starts(as_vector(arrays["index"], "index"), done)
    transitions = close_episodes(replace(transitions, terminated=terminated, truncated=done & ~terminated), starts)
    dataset = Dataset(transitions, starts, task_name=task.name, physics="legacy", origin=str(path))
    return validate(dataset, task, NEORL_NAMES, clip_actions=clip_actions)


def _rebuild(observation: np.ndarray, task: Task) -> np.ndarray:
    if task.state_from_observation is None:
        raise MadocError(
            f"an observation of {task.name} does not determine its state, so falls and time limits of a NeoRL file "
            "cannot be distinguished; give the task a state_from_observation, or convert the file"
        )
    return np.asarray(task.state_from_observation(observation))


def _without_root(values: np.ndarray, name: str, task: Task) -> Float[np.ndarray, "rows observation"]:
    observation = as_matrix(values, name)
    width = _rebuild(np.zeros(task.observation_size), task).shape[-1]
    if observation.shape[1] != width:
        raise MadocError(
            f"expected {width} values per observation for {task.name} (NeoRL keeps the root's position), "
            f"got {observation.shape[1]} in row 0 of {name}; is this file of {task.name}?"
        )
    return np.ascontiguousarray(observation[:, width - task.observation_size :])


def _episode_starts(index: np.ndarray, done: np.ndarray) -> Int[np.ndarray, " episodes"]:
    """Starts from `index` (ends or starts) and from `done`: a row after either never continues an episode."""
    rows = len(done)
    wrong = np.flatnonzero((index < 0) | (index > rows) | (index != np.round(index)))
    if len(wrong):
        raise MadocError(
            f"expected row numbers from 0 to {rows}, got {index[wrong[0]]:g} in row {wrong[0]} of index; "
            "the file is damaged, make it again"
        )
    starts = np.union1d(np.append(0, index.astype(int)), np.flatnonzero(done) + 1)
    return starts[starts < rows]
