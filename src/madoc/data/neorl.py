"""NeoRL's npz layout (Qin et al. 2022): `obs` with root positions, one `done` for falls and time limits."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from madoc.data.archives import holds, read_arrays
from madoc.data.dataset import Dataset, close_episodes
from madoc.data.validation import NAMES, as_matrix, as_transitions, as_vector, require_arrays, validate
from madoc.errors import MadocError
from madoc.tasks import Task

NAMES_HERE = {
    **NAMES,
    "observation": "obs",
    "next_observation": "next_obs",
    "terminated": "done",
    "truncated": "done",
}


def recognises(path: Path) -> bool:
    """Whether the file is an npz with `obs` and `next_obs`."""
    return holds(path, "obs", "next_obs")


def read(path: Path, task: Task, *, clip_actions: bool = False) -> Dataset:
    """Read a NeoRL file. Its leading root positions, which never enter the dynamics, are dropped.

    `done` marks falls and time limits alike: it terminates where the task ends at the state rebuilt from
    `next_obs`, and truncates elsewhere. `index` holds episode ends in NeoRL's files and episode starts in
    what its package returns (`neorl/utils.py` puts a 0 in front); both are read. Physics is legacy: NeoRL
    used mujoco-py.
    """
    arrays = read_arrays(path)
    require_arrays(arrays, (*NAMES_HERE.values(), "index"), path, "pass the --format it has")
    for name in ("obs", "next_obs"):
        arrays[name] = _without_root(arrays[name], name, task)
    transitions = as_transitions(arrays, NAMES_HERE)
    done = np.asarray(transitions.terminated)
    terminated = done & np.asarray(task.terminated(_rebuild(arrays["next_obs"], task)), dtype=bool)
    starts = _episode_starts(as_vector(arrays["index"], "index"), done)
    transitions = close_episodes(replace(transitions, terminated=terminated, truncated=done & ~terminated), starts)
    dataset = Dataset(transitions, starts, task_name=task.name, physics="legacy", origin=str(path))
    return validate(dataset, task, NAMES_HERE, clip_actions=clip_actions)


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
