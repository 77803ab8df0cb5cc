"""Logs of a user's robot: `read` makes a dataset of files and folders, for a robot whose spec names their columns.

Each format has one reader, which returns runs of named columns; `assembly.py` makes transitions of them.
"""

import os
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from pathlib import Path

from madoc.data.dataset import Dataset
from madoc.data.findings import Finding
from madoc.data.logs import parquet_reader
from madoc.data.logs.assembly import assemble, wanted_columns
from madoc.data.logs.jumps import split_episodes, without_copies
from madoc.data.logs.messages import read_bag, read_mcap
from madoc.data.logs.readers import read_csv, read_hdf5, read_minari, read_npz
from madoc.data.logs.tables import Run
from madoc.data.minari_reader import recognises as is_minari
from madoc.data.validation import LARGEST_OF_ALL, check_size, require_file, validate
from madoc.errors import MadocError, listed
from madoc.robots import Robot

_READERS: dict[str, Callable[[Path, Collection[str]], list[Run]]] = {
    **dict.fromkeys((".csv", ".tsv", ".txt"), read_csv),
    ".npz": read_npz,
    **dict.fromkeys((".h5", ".hdf5", ".hdf"), read_hdf5),
    **dict.fromkeys((".parquet", ".pq"), parquet_reader.read),
    ".mcap": read_mcap,
    ".db3": read_bag,
}
"""By the ending of a file: (path, wanted columns) -> runs, which may have other columns too. A file that is damaged,
too large or of another layout raises a MadocError, as does a library that is not installed."""
_SUFFIX_LIST = ", ".join(_READERS)
_NOT_LOGS = frozenset((".yaml", ".yml", ".xml", ".urdf", ".md", ".json", ".pdf", ".png", ".jpg", ".stl", ".obj", ""))
"""Endings of files that are often kept beside logs; they are skipped without a note."""
_PROSE = frozenset(("readme", "license", "notes", "changelog"))
"""Names, without their endings, of files that are no logs even where their endings are those of logs."""
_OF_A_RUN = ("metrics.jsonl", "result.json", "data.npz")
"""Files that, beside spec.json, mark a run folder of Madoc."""
_OF_A_SUITE = ("plans", "cells")
"""Folders that mark the folder of a suite of Madoc."""


def read(
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]], robot: Robot, *, clip_actions: bool = False
) -> Dataset:
    """Read logs of a robot from files and folders; each file, or each episode in one, is a run.

    Observations are the spec's signals in its order and units, actions are scaled to [-1, 1] by their ranges, rewards
    are 0 and nothing terminates. The dataset's `findings` say what was cut or resampled. Actions outside their
    channels' ranges are refused, or clipped with `clip_actions`.

    Raises:
        MadocError: One sentence: the file, the row and column, what was expected, what is there, what to do.
    """
    given = [paths] if isinstance(paths, str | os.PathLike) else paths
    sources = [Path(path).expanduser() for path in given]
    if not sources:
        raise MadocError("expected at least one file or folder of logs, got none")
    wanted = set(wanted_columns(robot).values())
    contents = [_runs(source, wanted | {robot.spec.log.time}) for source in sources]
    check_size(sum(run.size for runs, _ in contents for run in runs), "all logs together", LARGEST_OF_ALL)
    runs, findings = without_copies(_distinct([run for of_source, _ in contents for run in of_source]), sorted(wanted))
    episodes = [split_episodes(run, wanted) for run in runs]
    runs = [run for parts, _ in episodes for run in parts]
    findings += [finding for _, told in episodes for finding in told]
    ignored = [file for _, others in contents for file in others]
    origin = str(sources[0]) + (f" and {len(sources) - 1} more" if len(sources) > 1 else "")
    dataset = validate(assemble(runs, robot, origin=origin, clip_actions=clip_actions), robot.task)
    if ignored:
        findings.append(Finding("note", f"{listed(ignored, 3)} were not read: no reader knows them", dataset.origin))
    return replace(dataset, findings=(*findings, *dataset.findings))


def visible_files(folder: Path) -> list[Path]:
    """The files of a folder and of those in it, but for hidden ones, in the order of their names."""
    files = (file for file in folder.rglob("*") if file.is_file())
    return sorted(file for file in files if not any(part.startswith(".") for part in file.relative_to(folder).parts))


def files_of(folder: Path) -> list[Path]:
    """The files of a folder that count for what `read` makes of it, in the order of their names.

    Hidden files, prose and what is often kept beside logs do not count, nor does anything that Madoc itself has left.
    """
    visible = visible_files(folder)
    if parquet_reader.is_lerobot(folder) or is_minari(folder):
        return visible
    return [
        file
        for file in visible
        if file.stem.lower() not in _PROSE
        and file.suffix.lower() not in _NOT_LOGS
        and not _is_of_a_run_folder(file, folder)
    ]


def _runs(source: Path, wanted: Collection[str]) -> tuple[list[Run], list[str]]:
    """The runs of a file or folder, and the files in it that no reader reads."""
    if not source.is_dir():
        require_file(source)
        reader = _READERS.get(source.suffix.lower())
        if reader is None:
            raise MadocError(f"expected a log that ends in {_SUFFIX_LIST}, got {source}; convert it to CSV, say")
        return reader(source, wanted), []
    if parquet_reader.is_lerobot(source):
        return parquet_reader.read_lerobot(source, wanted), []
    if is_minari(source):
        return read_minari(source, wanted), []
    runs: list[Run] = []
    ignored: list[str] = []
    size = 0
    for file in files_of(source):
        name, suffix = file.relative_to(source).as_posix(), file.suffix.lower()
        if suffix in _READERS:
            require_file(file)
            read_runs = _READERS[suffix](file, wanted)
            runs += [replace(run, name=run.name.replace(file.name, name, 1)) for run in read_runs]
            size += sum(run.size for run in read_runs)
            check_size(size, f"the logs in {source}", LARGEST_OF_ALL)
        else:
            ignored.append(name)
    if not runs:
        raise MadocError(f"expected logs in the folder {source} (files that end in {_SUFFIX_LIST}), got none")
    return runs, ignored


def _is_of_a_run_folder(file: Path, source: Path) -> bool:
    """Whether a file is in a run folder or the folder of a suite of Madoc, whose arrays and tables are no logs."""
    folders = (folder for folder in file.parents if folder.is_relative_to(source))
    return any(
        ((folder / "spec.json").is_file() and any((folder / name).is_file() for name in _OF_A_RUN))
        or all((folder / name).is_dir() for name in _OF_A_SUITE)
        for folder in folders
    )


def _distinct(runs: list[Run]) -> list[Run]:
    """The runs, of which those of equal names, from files in several folders, are numbered."""
    seen: Counter[str] = Counter()
    named = []
    for run in runs:
        seen[run.name] += 1
        named.append(run if seen[run.name] == 1 else replace(run, name=f"{run.name} ({seen[run.name]})"))
    return named


__all__ = ["files_of", "read", "visible_files"]
