"""Logs of a user's robot: `read` makes a dataset of files and folders, for a robot whose spec names their columns.

Each format has one reader, which returns runs of named columns; `assembly.py` makes transitions of them.
"""

import os
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from madoc.data.dataset import Dataset
from madoc.data.findings import Finding
from madoc.data.logs import (
    csv_reader,
    hdf5_reader,
    lerobot_reader,
    mcap_reader,
    minari_runs,
    npz_reader,
    parquet_reader,
)
from madoc.data.logs.assembly import assemble, wanted_columns
from madoc.data.logs.tables import Run, Table
from madoc.data.minari_reader import recognises as is_minari
from madoc.data.validation import require_file, validate
from madoc.errors import MadocError, listed
from madoc.robots import Robot


@dataclass(frozen=True)
class LogFormat:
    """A layout of logs.

    Attributes:
        read: (path, wanted columns) -> runs.
        suffixes: Endings of its files; empty where it is a folder.
        description: A short description of the layout, for lists.
    """

    read: Callable[[Path, Collection[str]], list[Run]]
    suffixes: tuple[str, ...]
    description: str


LOG_FORMATS: dict[str, LogFormat] = {
    "csv": LogFormat(csv_reader.read, (".csv", ".tsv", ".txt"), "a header, then one line for each row"),
    "npz": LogFormat(npz_reader.read, (".npz",), "one array for each column"),
    "hdf5": LogFormat(
        hdf5_reader.read, (".h5", ".hdf5", ".hdf"), "one dataset for each column; numbered groups are runs"
    ),
    "parquet": LogFormat(parquet_reader.read, (".parquet", ".pq"), "columns of numbers or of lists"),
    "mcap": LogFormat(mcap_reader.read, (".mcap",), "topics of JSON or ROS 2 messages"),
    "minari": LogFormat(minari_runs.read, (), "a Minari directory: each episode is a run"),
    "lerobot": LogFormat(lerobot_reader.read, (), "a LeRobot directory: each episode is a run"),
}

_BY_SUFFIX = {suffix: name for name, entry in LOG_FORMATS.items() for suffix in entry.suffixes}
_SUFFIX_LIST = ", ".join(_BY_SUFFIX)
_NOT_LOGS = frozenset((".yaml", ".yml", ".xml", ".urdf", ".md", ".json", ".pdf", ".png", ".jpg", ".stl", ".obj", ""))
"""Endings of files that lie beside logs; they are skipped without a note."""
_OF_A_RUN = ("metrics.jsonl", "result.json")
"""Files that, beside spec.json, mark a run folder of Madoc."""


def read(
    paths: str | os.PathLike | Iterable[str | os.PathLike], robot: Robot, *, clip_actions: bool = False
) -> Dataset:
    """Read logs of a robot from files and folders; each file, or each episode in one, is a run.

    Observations are the spec's signals in its order and units, actions are scaled to [-1, 1] by their ranges, rewards
    are 0 and nothing terminates. The dataset's `findings` tell what was cut or resampled.

    Args:
        paths: A file or folder, or several.
        robot: A robot of `robots.load`.
        clip_actions: Clip actions outside their channels' ranges instead of refusing them.

    Raises:
        MadocError: One sentence: the file, the row and column, what was expected, what is there, what to do.
    """
    given = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    sources = [Path(path).expanduser() for path in given]
    if not sources:
        raise MadocError("expected at least one file or folder of logs, got none")
    wanted = set(wanted_columns(robot).values())
    runs: list[Run] = []
    ignored: list[str] = []
    for source in sources:
        of_source, others = _runs(source, wanted)
        runs += of_source
        ignored += others
    origin = str(sources[0]) + (f" and {len(sources) - 1} more" if len(sources) > 1 else "")
    dataset = validate(assemble(_distinct(runs), robot, origin=origin, clip_actions=clip_actions), robot.task)
    if ignored:
        finding = Finding("note", f"{listed(ignored, 3)} were not read: no reader knows them", dataset.origin)
        dataset = replace(dataset, findings=(finding, *dataset.findings))
    return dataset


def _runs(source: Path, wanted: Collection[str]) -> tuple[list[Run], list[str]]:
    """The runs of a file or folder, and the files in it that no reader knows."""
    if not source.is_dir():
        require_file(source)
        return _entry(source).read(source, wanted), []
    if lerobot_reader.recognises(source):
        return LOG_FORMATS["lerobot"].read(source, wanted), []
    if is_minari(source):
        return LOG_FORMATS["minari"].read(source, wanted), []
    files = sorted(
        file
        for file in source.rglob("*")
        if file.is_file()
        and not any(part.startswith(".") for part in file.relative_to(source).parts)
        and not _is_of_a_run_folder(file, source)
    )
    known = [file for file in files if file.suffix.lower() in _BY_SUFFIX and not _is_prose(file)]
    others = [file for file in files if file not in known and file.suffix.lower() not in _NOT_LOGS]
    if not known:
        raise MadocError(f"expected logs in the folder {source} (files that end in {_SUFFIX_LIST}), got none")
    runs = []
    for file in known:
        require_file(file)
        name = file.relative_to(source).as_posix()
        of_file = _entry(file).read(file, wanted)
        runs += [replace(run, name=run.name.replace(file.name, name, 1)) for run in of_file]
    return runs, [file.relative_to(source).as_posix() for file in others if not _is_prose(file)]


def _is_of_a_run_folder(file: Path, source: Path) -> bool:
    """Whether a file is in a run folder of Madoc, which holds arrays too."""
    folders = (folder for folder in file.parents if folder.is_relative_to(source))
    return any(
        (folder / "spec.json").is_file() and any((folder / name).is_file() for name in _OF_A_RUN) for folder in folders
    )


def _is_prose(file: Path) -> bool:
    return file.stem.lower() in ("readme", "license", "notes", "changelog")


def _entry(file: Path) -> LogFormat:
    suffix = file.suffix.lower()
    if suffix not in _BY_SUFFIX:
        raise MadocError(f"expected a log that ends in {_SUFFIX_LIST}, got {file}; convert it to CSV, say")
    return LOG_FORMATS[_BY_SUFFIX[suffix]]


def _distinct(runs: list[Run]) -> list[Run]:
    """Runs of equal names, from files of equal names in several folders, numbered."""
    seen: dict[str, int] = {}
    named = []
    for run in runs:
        seen[run.name] = seen.get(run.name, 0) + 1
        count = seen[run.name]
        named.append(run if count == 1 else replace(run, name=f"{run.name} ({count})"))
    return named


__all__ = ["LOG_FORMATS", "LogFormat", "Run", "Table", "read"]
