"""Small logged data of each robot, and the same data written in each format's layout."""

import json
from copy import copy
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from madoc.data import Dataset, save
from madoc.data.dataset import close_episodes
from madoc.types import Transitions

REAL = Path(__file__).parents[2] / ".." / "shared" / "data" / "berkeley_v4_expert"


def make_dataset(task, lengths=(4, 3, 5, 2), falls=(1,), seed=0):
    """Episodes of random observations. Those numbered in `falls` end fallen, others at the record's end."""
    generator = np.random.default_rng(seed)
    width, motors = task.observation_size, task.compile().nu
    observation, following, terminated = [], [], []
    for number, length in enumerate(lengths):
        chain = generator.uniform(-0.1, 0.1, (length + 1, width)).astype(np.float32).astype(np.float64)
        chain[:, 0] = 1.25 if task.name != "ant" else 0.625
        flags = np.zeros(length, dtype=bool)
        if number in falls:
            chain[-1, 0] = 0.125
            flags[-1] = True
        observation.append(chain[:-1])
        following.append(chain[1:])
        terminated.append(flags)
    rows = sum(lengths)
    starts = np.append(0, np.cumsum(lengths)[:-1])
    transitions = Transitions(
        observation=np.concatenate(observation),
        action=generator.uniform(-1, 1, (rows, motors)).astype(np.float32).astype(np.float64),
        reward=np.arange(rows, dtype=np.float64),
        next_observation=np.concatenate(following),
        terminated=np.concatenate(terminated),
        truncated=np.zeros(rows, dtype=bool),
    )
    return Dataset(close_episodes(transitions, starts), starts, task.name, "legacy", "made by a test")


def with_fields(dataset, **fields):
    """The dataset with other columns, even such as the suite's checks of shapes would not let pass."""
    transitions = copy(dataset.transitions)
    vars(transitions).update(fields)
    return replace(dataset, transitions=transitions)


def d4rl_arrays(dataset):
    rows = dataset.transitions
    return {
        "observations": rows.observation.astype(np.float32),
        "actions": rows.action.astype(np.float32),
        "rewards": rows.reward.astype(np.float32),
        "next_observations": rows.next_observation.astype(np.float32),
        "terminals": rows.terminated,
        "timeouts": rows.truncated,
    }


def write_hdf5(path, arrays):
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values
    return path


def neorl_arrays(dataset):
    rows = dataset.transitions
    root = np.arange(len(dataset), dtype=np.float64)[:, None]
    done = (rows.terminated | rows.truncated)[:, None]
    return {
        "obs": np.hstack([root, rows.observation]),
        "next_obs": np.hstack([root + 1, rows.next_observation]),
        "action": rows.action,
        "reward": rows.reward[:, None],
        "done": done.astype(np.float32),
        "index": dataset.episode_ends,
    }


def write_npz(path, arrays):
    np.savez(path, **arrays)
    return path


def write_minari(folder, dataset, *, environment=None, widen=0):
    """Minari's HDF5 layout, written by hand: one group an episode, one observation more than actions."""
    rows = dataset.transitions
    data = folder / "data"
    data.mkdir(parents=True)
    width = rows.observation.shape[1] + widen
    metadata = {
        "total_episodes": len(dataset.episode_starts),
        "total_steps": len(dataset),
        "data_format": "hdf5",
        "observation_space": _box(width),
        "action_space": _box(rows.action.shape[1]),
        "dataset_id": "test/made-v0",
        "minari_version": "0.5.3",
    }
    if environment:
        metadata["env_spec"] = json.dumps(
            {"id": environment, "entry_point": "nowhere:Nothing", "kwargs": {}, "additional_wrappers": []}
        )
    (data / "metadata.json").write_text(json.dumps(metadata))
    with h5py.File(data / "main_data.hdf5", "w") as file:
        spans = zip(dataset.episode_starts, dataset.episode_ends, strict=True)
        for number, (start, end) in enumerate(spans):
            group = file.create_group(f"episode_{number}")
            chain = np.vstack([rows.observation[start:end], rows.next_observation[end - 1 : end]])
            group["observations"] = np.hstack([chain, np.full((len(chain), widen), 0.5)])
            group["actions"] = rows.action[start:end]
            group["rewards"] = rows.reward[start:end]
            group["terminations"] = rows.terminated[start:end]
            group["truncations"] = rows.truncated[start:end]
    return folder


def _box(width):
    return json.dumps(
        {"type": "Box", "dtype": "float64", "shape": [width], "low": [-1e9] * width, "high": [1e9] * width}
    )


def write(form, folder, dataset):
    """The dataset as a file of the format, and its path."""
    if form == "d4rl":
        return write_hdf5(folder / "made-v2.hdf5", d4rl_arrays(dataset))
    if form == "neorl":
        return write_npz(folder / "neorl.npz", neorl_arrays(dataset))
    if form == "minari":
        return write_minari(folder / "minari", dataset)
    save(dataset, folder / "madoc.npz")
    return folder / "madoc.npz"
