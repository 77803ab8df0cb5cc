"""Madoc's own file: an npz of the arrays and one JSON string. It is written atomically and never holds a pickle."""

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import TypeAdapter, ValidationError

from madoc.data.dataset import Dataset
from madoc.data.disturbance import Disturbance
from madoc.data.disturbing import observed_task
from madoc.data.findings import Finding
from madoc.data.npz import array_names, is_npz, read_arrays
from madoc.data.validation import NAMES, as_transitions, require_arrays, validate
from madoc.errors import MadocError
from madoc.parameters import FIELDS
from madoc.runs.files import json_text, replacing
from madoc.tasks import Task

Part = TypeVar("Part")
VERSION = 1
REQUIRED = (*NAMES, "episode_starts", "metadata")


def recognises(path: Path) -> bool:
    """Whether the file is an npz with our metadata."""
    return is_npz(path) and {"metadata", "episode_starts"} <= array_names(path)


def save(dataset: Dataset, path: str | os.PathLike) -> None:
    """Write a dataset whole or not at all: a failure leaves `path` as it was.

    Raises:
        MadocError: The folder does not exist, `path` is a directory, or the disk refuses.
    """
    target = Path(path).expanduser()
    if target.is_dir():
        raise MadocError(f"expected a file to write to, got the directory {target}; add a file name")
    if not target.parent.is_dir():
        raise MadocError(f"no folder {target.parent} to write {target.name} into; make it first")
    arrays = _arrays(dataset)
    with replacing(target) as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def load(path: str | os.PathLike) -> Dataset:
    """Read a file of `save`, bit for bit.

    Raises:
        MadocError: Missing, damaged, not ours, or of another version.
    """
    source = Path(path).expanduser()
    arrays = read_arrays(source)
    require_arrays(arrays, REQUIRED, source, "it is not a file of Madoc, pass the --format it has")
    metadata = _metadata(arrays["metadata"], source)
    return Dataset(
        as_transitions(arrays),
        _row_numbers(arrays["episode_starts"], source),
        task_name=metadata["task_name"],
        physics=metadata["physics"],
        origin=metadata["origin"],
        true_parameters=metadata["true_parameters"],
        disturbance=_part(Disturbance, metadata.get("disturbance", {}), source),
        run_names=_part(tuple[str, ...], metadata["run_names"], source) if metadata.get("run_names") else None,
        findings=_part(tuple[Finding, ...], metadata.get("findings", ()), source),
    )


def read(path: Path, task: Task, *, clip_actions: bool = False) -> Dataset:
    """`load`, checked against a task.

    Raises:
        MadocError: As `load`, or refused by `validate`.
    """
    dataset = load(path)
    return validate(dataset, observed_task(task, dataset), clip_actions=clip_actions)


def _arrays(dataset: Dataset) -> dict[str, np.ndarray]:
    truth = dataset.true_parameters
    metadata = {
        "version": VERSION,
        "task_name": dataset.task_name,
        "physics": dataset.physics,
        "origin": dataset.origin,
        "true_parameters": None if truth is None else {name: float(value) for name, value in truth.items()},
        "disturbance": asdict(dataset.disturbance),
        "run_names": dataset.run_names,
        "findings": [finding.to_json() for finding in dataset.findings],
        "parameter_units": {name: _unit(name) for name in truth or {}},
    }
    arrays = {name: np.asarray(getattr(dataset.transitions, name)) for name in NAMES}
    starts = np.asarray(dataset.episode_starts)
    return {**arrays, "episode_starts": starts, "metadata": np.array(json_text(metadata, what="metadata"))}


def _unit(parameter_name: str) -> str:
    """The unit of `field.element`, for people who open the file; empty for an unknown field."""
    field = FIELDS.get(parameter_name.split(".")[0])
    return "" if field is None else field.unit


def _row_numbers(values: np.ndarray, path: Path) -> np.ndarray:
    if values.ndim != 1 or values.dtype.kind not in "iu":
        raise MadocError(
            f"expected row numbers in episode_starts of {path}, got shape {values.shape} of {values.dtype}; "
            "the file is damaged, make it again"
        )
    return values.astype(np.int64)


def _part(kind: type[Part], fields: object, path: Path) -> Part:
    """A part of the metadata as its type."""
    try:
        return TypeAdapter(kind).validate_python(fields)
    except ValidationError as error:
        raise MadocError(f"the metadata of {path} cannot be read ({error})") from error


def _metadata(text: np.ndarray, path: Path) -> dict:
    try:
        metadata = json.loads(str(text))
        version = metadata["version"]
    except (ValueError, TypeError, KeyError) as error:
        raise MadocError(f"metadata of {path} cannot be read ({error}); the file is damaged, make it again") from error
    if version != VERSION:
        raise MadocError(f"expected file version {VERSION}, got {version} in {path}; use the Madoc that wrote it")
    missing = {"task_name", "physics", "origin", "true_parameters"} - set(metadata)
    if missing:
        raise MadocError(f"no {min(missing)!r} in the metadata of {path}; the file is damaged, make it again")
    return metadata
