"""Checks that all readers share, so that a bad file is refused with one sentence before any budget is spent."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from madoc.data.dataset import Dataset
from madoc.errors import MadocError
from madoc.tasks import Task
from madoc.types import Transitions

LARGEST = 500_000_000
"""Largest size of what is read of one log, bytes in memory: four million rows of twelve numbers, and a clock."""
LARGEST_OF_ALL = 2_000_000_000
"""Largest size of what is read of all logs together, bytes in memory."""
LARGEST_DATASET = 4_000_000_000
"""Largest size of a data set of one of Madoc's own robots, bytes in memory: two million rows of an Ant have half."""

ACTION_TOLERANCE = 1e-5
"""Distance of an action from [-1, 1], up to which it is clipped silently as a rounding error; beyond, it is refused."""
FLOATS = ("observation", "action", "reward", "next_observation")
NAMES = {name: name for name in (*FLOATS, "terminated", "truncated")}


def check_size(size: int, what: str, most: int) -> None:
    """Refuse what would take more memory than a bound, bytes, before it is read."""
    if size > most:
        raise MadocError(
            f"{what} take {size:,} bytes of memory or more, at most {most:,} are read; split the log or record less"
        )


def require_file(path: Path) -> None:
    """Refuse a path at which there is nothing, a directory, or an empty file."""
    if path.is_dir():
        raise MadocError(f"expected a file, got the directory {path}; name one of the files in it")
    if not path.is_file():
        raise MadocError(f"no file at {path}; check the path")
    if path.stat().st_size == 0:
        raise MadocError(f"{path} is empty; copy or download it again")


def require_arrays(present: Collection[str], required: Collection[str], path: Path, hint: str) -> None:
    """Refuse a file that lacks an array of its layout; the sentence ends with the hint."""
    missing = [name for name in required if name not in present]
    if missing:
        there = ", ".join(sorted(present)) or "none of the layout's arrays"
        raise MadocError(f"no array {missing[0]!r} in {path}, there is: {there}; {hint}")


def as_matrix(values: np.ndarray, name: str) -> Float[np.ndarray, "rows values"]:
    """Values as float64 rows; other than numbers on two axes are refused."""
    numbers = _as_numbers(values, name)
    if numbers.ndim != 2:
        raise MadocError(f"expected {name} of shape (rows, values), got shape {numbers.shape}")
    return numbers


def as_vector(values: np.ndarray, name: str) -> Float[np.ndarray, " rows"]:
    """Values as float64, one per row, maybe on a second axis of length 1; others are refused."""
    numbers = _as_numbers(values, name)
    if numbers.ndim == 2 and numbers.shape[1] == 1:
        numbers = numbers[:, 0]
    if numbers.ndim != 1:
        raise MadocError(f"expected one value per row in {name}, got shape {numbers.shape}")
    return numbers


def as_flags(values: np.ndarray, name: str) -> Bool[np.ndarray, " rows"]:
    """Values as bool, one per row; a value that is neither 0 nor 1 is refused."""
    numbers = as_vector(values, name)
    odd = np.flatnonzero((numbers != 0) & (numbers != 1))
    if len(odd):
        raise MadocError(f"expected 0 or 1, got {numbers[odd[0]]:g} in row {odd[0]} of {name}")
    return numbers.astype(bool)


def as_transitions(arrays: Mapping[str, np.ndarray], names: Mapping[str, str] = NAMES) -> Transitions:
    """Arrays of a file as transitions; `names` gives the file's name of each field.

    Raises:
        MadocError: An array has the wrong kind of values, the wrong shape, or another number of rows.
    """
    kinds = {"reward": as_vector, "terminated": as_flags, "truncated": as_flags}
    fields = {field: kinds.get(field, as_matrix)(arrays[name], name) for field, name in names.items()}
    _check_lengths(fields, names)
    return Transitions(**fields)


def validate(dataset: Dataset, task: Task, names: Mapping[str, str] = NAMES, *, clip_actions: bool = False) -> Dataset:
    """The dataset, if it fits the task, with actions clipped to [-1, 1]: of any size if asked for, else roundings.

    `names` are the file's names of the fields of `Transitions`, for error sentences.

    Raises:
        MadocError: Another task, no rows, lengths that disagree, a wrong width, a value that is not finite,
            an action outside [-1, 1], or episode starts that are not ascending rows from 0.
    """
    transitions = dataset.transitions
    if dataset.task_name != task.name:
        raise MadocError(f"expected data of {task.name}, got data of {dataset.task_name} in {dataset.origin}")
    _check_lengths({field: np.asarray(getattr(transitions, field)) for field in NAMES}, names)
    if not len(dataset):
        raise MadocError(f"expected at least one transition for {task.name}, got none in {dataset.origin}")
    columns = {field: np.asarray(getattr(transitions, field)) for field in FLOATS}
    for field in ("observation", "next_observation", "action"):
        _check_width(columns[field], task, field, names[field])
    for field, values in columns.items():
        _check_finite(values, names[field])
    _check_episode_starts(dataset)
    if not clip_actions:
        _check_actions(columns["action"], names["action"])
    action = np.clip(columns["action"], -1.0, 1.0)
    return replace(dataset, transitions=replace(transitions, action=action))


def _as_numbers(values: np.ndarray, name: str) -> np.ndarray:
    array = np.asarray(values)
    if array.dtype.kind not in "fiub":
        raise MadocError(f"expected numbers in {name}, got dtype {array.dtype}")
    return array.astype(np.float64)


def _check_lengths(fields: Mapping[str, np.ndarray], names: Mapping[str, str]) -> None:
    (first, values), *others = fields.items()
    for field, other in others:
        if len(other) != len(values):
            raise MadocError(
                f"expected as many rows in {names[field]} as in {names[first]}, got {len(other)} and {len(values)}; "
                "the file is damaged or was written in part, make it again"
            )


def _check_width(values: np.ndarray, task: Task, field: str, name: str) -> None:
    what, expected = ("action", task.action_size) if field == "action" else ("observation", task.observation_size)
    got = values.shape[-1]
    if got != expected:
        neorl = what == "observation" and got == expected + 1
        hint = "a NeoRL file? pass --format neorl" if neorl else f"is this file of {task.name}?"
        raise MadocError(f"expected {expected} values per {what} for {task.name}, got {got} in row 0 of {name}; {hint}")


def _check_finite(values: np.ndarray, name: str) -> None:
    places = np.argwhere(~np.isfinite(values))
    if len(places):
        rows = np.unique(places[:, 0])
        raise MadocError(
            f"expected finite values, got {values[tuple(places[0])]} in row {rows[0]} of {name} "
            f"({len(rows)} such rows); drop those rows where the file is made"
        )


def _check_actions(action: np.ndarray, name: str) -> None:
    size = np.abs(action).max(axis=1, initial=0.0)
    rows = np.flatnonzero(size > 1.0 + ACTION_TOLERANCE)
    if len(rows):
        raise MadocError(
            f"expected actions in [-1, 1], got one of size {size[rows[0]]:.6g} in row {rows[0]} of {name} "
            f"({len(rows)} such rows); if the recording simulator clipped them at the motors, as Gymnasium's "
            "does, pass --clip-actions (clip_actions=True), else rescale them"
        )


def _check_episode_starts(dataset: Dataset) -> None:
    starts = dataset.episode_starts
    if len(starts) and starts[0] == 0 and (np.diff(starts) > 0).all() and starts[-1] < len(dataset):
        return
    raise MadocError(
        f"expected ascending episode starts from 0 to below {len(dataset)}, got {starts[:5]} in "
        f"{dataset.origin}; make the file again"
    )
