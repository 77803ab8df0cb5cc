"""The formats of logged data and their readers. A new format is one reader and one line of `FORMATS`."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import PRNGKeyArray

from madoc.data import minari_reader, native, offline_rl
from madoc.data.dataset import Dataset, subsample
from madoc.data.validation import require_file
from madoc.errors import MadocError, unknown_name
from madoc.tasks import Task


@dataclass(frozen=True)
class Format:
    """A layout of logged data.

    Attributes:
        read: (path, task, clip_actions=...) -> validated dataset. A file that is missing, damaged, of another layout
            or refused by `validate` raises a MadocError, as does a library that is not installed.
        recognises: path -> whether it has this layout, from the beginning of its content.
        description: A short description of the layout, for lists.
    """

    read: Callable[..., Dataset]
    recognises: Callable[[Path], bool]
    description: str


FORMATS: dict[str, Format] = {
    "d4rl": Format(offline_rl.read_d4rl, offline_rl.is_d4rl, "HDF5 with observations, actions, rewards, terminals"),
    "neorl": Format(offline_rl.read_neorl, offline_rl.is_neorl, "npz with obs, next_obs, action, reward, done, index"),
    "minari": Format(minari_reader.read, minari_reader.recognises, "a Minari directory or id"),
    "madoc": Format(native.read, native.recognises, "npz that madoc wrote"),
}


def load(
    path: str | os.PathLike[str],
    task: Task,
    *,
    format: str | None = None,
    max_transitions: int | None = None,
    key: PRNGKeyArray | None = None,
    clip_actions: bool = False,
    download: bool = False,
) -> Dataset:
    """Read logged data of a robot in any of the supported formats.

    Args:
        path: A file, a Minari directory, or a Minari id.
        task: The robot.
        format: A name in `FORMATS`; None recognises the format from the content.
        max_transitions: Largest number of transitions to keep (see `subsample`); needs a key.
        key: Randomness of the episodes to keep.
        clip_actions: Clip actions outside [-1, 1] instead of refusing them.
        download: Fetch a Minari id that is not on this machine. Without it nothing touches the network.

    Raises:
        MadocError: Missing, unreadable, of no supported format, or not data of this task.
    """
    source = Path(path).expanduser()
    check_format(format)
    if max_transitions is not None and key is None:
        raise MadocError("max_transitions draws episodes at random and needs a key, got none; pass key=")
    name = format or recognise(source)
    if download:
        if name != "minari":
            raise MadocError(f"only Minari ids can be downloaded, got {source} of format {name}")
        if not source.exists():
            minari_reader.download(source.as_posix())
    dataset = FORMATS[name].read(source, task, clip_actions=clip_actions)
    if max_transitions is None or key is None:
        return dataset
    return subsample(dataset, max_transitions, key)


def check_format(name: str | None) -> None:
    """Refuse a name that is not in `FORMATS`; None stands for any of them."""
    if name is not None and name not in FORMATS:
        raise unknown_name("format", name, FORMATS)


def recognise(path: Path) -> str:
    """The name of a file's format, from its content.

    Raises:
        MadocError: Missing, empty, damaged beyond recognition, or of no supported format.
    """
    for name, candidate in FORMATS.items():
        if candidate.recognises(path):
            return name
    require_file(path)
    known = "; ".join(f"{name} ({candidate.description})" for name, candidate in FORMATS.items())
    raise MadocError(f"cannot tell the format of {path}; pass --format with one of: {known}")
