"""Minari datasets (Younis et al. 2024): a directory of episodes, or the id of a dataset on this machine."""

import re
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import h5py
import numpy as np

from madoc.data.archives import opened, size_of
from madoc.data.dataset import Dataset, close_episodes, join
from madoc.data.validation import LARGEST_DATASET, as_matrix, as_transitions, check_size, validate
from madoc.errors import MadocError, needing
from madoc.tasks import Task
from madoc.types import Transitions

if TYPE_CHECKING:
    from minari import EpisodeData

ID = re.compile(r"[\w-]+(/[\w-]+)*-v\d+")
ANT_V5_WIDTH, ANT_STATE_WIDTH = 105, 27
"""Values of Ant-v5: 27 of state, then 78 contact forces, which the state determines."""
NAMES_HERE = {
    "reward": "rewards",
    "observation": "observations",
    "action": "actions",
    "next_observation": "observations",
    "terminated": "terminations",
    "truncated": "truncations",
}


def recognises(path: Path) -> bool:
    """Whether the path is a Minari directory, or an id such as `mujoco/hopper/expert-v0`."""
    if path.exists():
        return _data_directory(path) is not None
    return ID.fullmatch(path.as_posix()) is not None


def read(path: Path, task: Task, *, clip_actions: bool = False) -> Dataset:
    """Read a Minari dataset, by its directory or by its id. Never touches the network.

    An Ant of 105 values keeps the first 27, and the rewards keep the contact cost they were recorded with.
    Physics is modern for environments v4 and later, legacy before, unknown without an environment. Rows are
    counted over all episodes joined.
    """
    episodes, environment = read_episodes(local_directory(path))
    if not episodes:
        raise MadocError(f"expected at least one episode for {task.name}, got none in {path}")
    version = re.search(r"-v(\d+)$", environment)
    physics = "unknown" if version is None else "modern" if int(version[1]) >= 4 else "legacy"
    parts = [_transitions(episode, task) for episode in episodes]
    _check_widths([part.observation.shape[1] for part in parts], "observations")
    _check_widths([part.action.shape[1] for part in parts], "actions")
    start = np.zeros(1, dtype=np.int64)
    dataset = join(
        [Dataset(close_episodes(part, start), start, task.name, physics, str(path)) for part in parts], str(path)
    )
    return validate(dataset, task, NAMES_HERE, clip_actions=clip_actions)


def download(dataset_id: str) -> None:
    """Fetch a Minari dataset from its public host, unless it is here. Nothing else needs a network."""
    minari = _import_minari()
    try:
        minari.load_dataset(dataset_id, download=True)
    except Exception as error:  # the client of the host raises errors of many types
        raise MadocError(
            f"cannot download Minari dataset {dataset_id!r} ({error}); check its id and the network"
        ) from error


def local_directory(path: Path) -> Path:
    """The folder of a dataset's episodes, by its folder or by its id; a path or id that is not here is refused."""
    directory = _data_directory(path)
    if directory is not None:
        return directory
    if path.exists():
        raise MadocError(f"{path} is no Minari dataset: there is no metadata.json in it or in its data folder")
    if ID.fullmatch(path.as_posix()) is None:
        raise MadocError(f"no file or directory at {path}; check the path")
    _import_minari()
    from minari.storage.datasets_root_dir import get_dataset_path

    directory = _data_directory(get_dataset_path(path.as_posix()))
    if directory is None:
        raise MadocError(
            f"no file, and no Minari dataset on this machine, is called {path.as_posix()}; check the name, "
            f"or fetch it with `minari download {path.as_posix()}` (download=True)"
        )
    return directory


def read_episodes(directory: Path) -> tuple[list["EpisodeData"], str]:
    """All episodes, and the id of their environment (empty if not recorded)."""
    minari = _import_minari()
    for file in directory.rglob("*.hdf5"):
        with opened(file, "it is damaged or was cut short, download or record it again") as held:
            sizes: list[int] = []
            held.visititems(
                lambda _, item, told=sizes: told.append(size_of(item)) if isinstance(item, h5py.Dataset) else None
            )
        check_size(sum(sizes), f"the Minari dataset in {directory}", LARGEST_DATASET)
    try:
        with warnings.catch_warnings():
            # Minari warns about packages its environment would need; the environment is never made here.
            warnings.simplefilter("ignore")
            dataset = minari.MinariDataset(directory)
            environment = dataset.spec.env_spec
            return list(dataset.iterate_episodes()), "" if environment is None else environment.id
    except Exception as error:  # its storages raise anything from AssertionError to OSError on a damaged file
        raise MadocError(
            f"cannot read the Minari dataset in {directory} ({type(error).__name__}: {error}); it is damaged "
            "or was cut short, download or record it again"
        ) from error


def _import_minari() -> ModuleType:
    with needing("Minari datasets need the library:", "minari[hdf5]"):
        import minari
    return minari


def _data_directory(path: Path) -> Path | None:
    """The folder with the metadata: the path itself or its `data`."""
    return next((folder for folder in (path / "data", path) if (folder / "metadata.json").is_file()), None)


def _transitions(episode: "EpisodeData", task: Task) -> Transitions:
    """The rows of an episode, which has one more observation than actions."""
    if isinstance(episode.observations, dict | tuple):
        raise MadocError(
            f"expected observations of {task.name} as one array, got a {type(episode.observations).__name__} "
            f"in episode {episode.id}; is this dataset of {task.name}?"
        )
    observation = as_matrix(episode.observations, "observations")
    steps = len(episode.rewards)
    if steps == 0 or len(observation) != steps + 1:
        raise MadocError(
            f"expected one more observation than rewards, and a reward, got {len(observation)} and {steps} "
            f"in episode {episode.id}; record it again"
        )
    if task.name == "ant" and observation.shape[1] == ANT_V5_WIDTH:
        observation = observation[:, :ANT_STATE_WIDTH]
    arrays = {name: getattr(episode, name) for name in NAMES_HERE.values()}
    rows = as_transitions({**arrays, "observations": observation[:-1]}, NAMES_HERE)
    return replace(rows, next_observation=observation[1:])


def _check_widths(widths: Sequence[int], name: str) -> None:
    for episode, width in enumerate(widths):
        if width != widths[0]:
            raise MadocError(
                f"expected {widths[0]} values per row of {name} in every episode, got {width} in episode {episode}; "
                "record them again from one robot"
            )
