"""LeRobot's local format (Cadene et al. 2024), versions 2 and 3: Parquet files and meta/info.json, without torch."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from madoc.data.logs.parquet_reader import read_columns
from madoc.data.logs.tables import Run, tables_of
from madoc.data.sizes import LARGEST_OF_ALL, check_size
from madoc.data.validation import require_file
from madoc.errors import MadocError
from madoc.runs.files import read_json

CLOCK = "timestamp"


def recognises(path: Path) -> bool:
    """Whether a folder is such a dataset."""
    return (path / "meta" / "info.json").is_file()


def read(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run for each episode. Elements of `observation.state` are `observation.state[0]`, ...

    Where meta/info.json names them, they are `observation.state[shoulder]` as well.
    """
    about = read_json(path / "meta" / "info.json")
    features = about.get("features") if isinstance(about, dict) else None
    files = sorted((path / "data").rglob("*.parquet"))
    if not isinstance(features, dict) or not files:
        what = "no features in meta/info.json" if files else "no Parquet file in its folder data"
        raise MadocError(f"{path.name} is no whole LeRobot dataset: {what}; download or record it again")
    episodes: dict[int, list[dict[str, np.ndarray]]] = {}
    unread: list[str] = []
    size = 0
    for file in files:
        require_file(file)
        columns, unread = read_columns(file, {*wanted, CLOCK})
        size += sum(values.nbytes for values in columns.values())
        check_size(size, f"the columns of {path.name} that are asked for", LARGEST_OF_ALL)
        if "episode_index" not in columns:
            raise MadocError(f"no column episode_index in {path.name}/{file.relative_to(path)}; is it of this dataset?")
        index = columns["episode_index"]
        for episode in np.unique(index):
            chosen = np.flatnonzero(index == episode)
            part = {name: values[chosen] for name, values in columns.items() if len(values) == len(index)}
            episodes.setdefault(int(episode), []).append(part)
    return [_run(path, episode, parts, features, unread) for episode, parts in sorted(episodes.items())]


def _run(
    path: Path,
    episode: int,
    parts: list[dict[str, np.ndarray]],
    features: Mapping[str, object],
    unread: Sequence[str],
) -> Run:
    """The run of an episode, of the parts of it that files have."""
    shared = [name for name in parts[0] if all(name in part for part in parts)]
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in shared}
    named = {
        f"{name}[{element}]": column
        for name, values in arrays.items()
        if len(elements := _element_names(features.get(name))) == values.shape[-1] and values.ndim == 2
        for element, column in zip(elements, values.T, strict=True)
    }
    tables = tables_of(arrays | named, clock=CLOCK)
    return Run(f"{path.name}/episode_{episode}", tuple(replace(table, unread=unread) for table in tables))


def _element_names(feature: object) -> list[str]:
    """Names of a feature's elements: a list, or one in a dictionary (`{"motors": [...]}`)."""
    names = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(names, dict):
        names = next(iter(names.values()), None)
    return [str(name) for name in names] if isinstance(names, list) else []
