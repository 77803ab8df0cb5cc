"""Madoc's own file: an npz of the arrays and one JSON string. It is written atomically and never holds a pickle."""

import json
import os
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from madoc.data.archives import holds, read_arrays
from madoc.data.dataset import Dataset
from madoc.data.disturbance import Disturbance
from madoc.data.disturbing import observed_task
from madoc.data.findings import Finding
from madoc.data.validation import NAMES, as_transitions, require_arrays, validate
from madoc.errors import MadocError
from madoc.parameters import FIELDS
from madoc.runs.files import json_text, replacing
from madoc.tasks import Task

VERSION = 1


@dataclass(frozen=True)
class _Metadata:
    """The fields of a `Dataset` that are kept as JSON."""

    task_name: str
    physics: str
    origin: str
    true_parameters: dict[str, float] | None
    disturbance: Disturbance = field(default_factory=Disturbance)
    run_names: tuple[str, ...] | None = None
    findings: tuple[Finding, ...] = ()


def recognises(path: Path) -> bool:
    """Whether the file is an npz with our metadata."""
    return holds(path, "metadata", "episode_starts")


def save(dataset: Dataset, path: str | os.PathLike[str]) -> None:
    """Write a dataset whole or not at all: a failure leaves `path` as it was.

    Raises:
        MadocError: The folder does not exist, `path` is a directory, or the disk refuses.
    """
    target = Path(path).expanduser()
    if target.is_dir():
        raise MadocError(f"expected a file to write to, got the directory {target}; add a file name")
    if not target.parent.is_dir():
        raise MadocError(f"no folder {target.parent} to write {target.name} into; make it first")
    about = asdict(_Metadata(**{part.name: getattr(dataset, part.name) for part in fields(_Metadata)}))
    if dataset.true_parameters is not None:
        about["true_parameters"] = {name: float(value) for name, value in dataset.true_parameters.items()}
    kinds = {name: FIELDS.get(name.split(".")[0]) for name in dataset.true_parameters or {}}
    units = {name: "" if kind is None else kind.unit for name, kind in kinds.items()}  # for people who open the file
    metadata = json_text({"version": VERSION, **about, "parameter_units": units}, what="metadata")
    arrays = {name: np.asarray(getattr(dataset.transitions, name)) for name in NAMES}
    starts = np.asarray(dataset.episode_starts)
    with replacing(target) as stream:
        np.savez(stream, allow_pickle=False, **arrays, episode_starts=starts, metadata=np.array(metadata))


def read(path: Path, task: Task, *, clip_actions: bool = False) -> Dataset:
    """Read a file of `save`, bit for bit.

    Raises:
        MadocError: Missing, damaged, not ours, of another version, or refused by `validate`.
    """
    arrays = read_arrays(path)
    hint = "it is not a file of Madoc, pass the --format it has"
    require_arrays(arrays, (*NAMES, "episode_starts", "metadata"), path, hint)
    metadata = _metadata(arrays["metadata"], path)
    dataset = Dataset(as_transitions(arrays), _row_numbers(arrays["episode_starts"], path), **vars(metadata))
    return validate(dataset, observed_task(task, dataset), clip_actions=clip_actions)


def _row_numbers(values: np.ndarray, path: Path) -> np.ndarray:
    if values.ndim != 1 or values.dtype.kind not in "iu":
        raise MadocError(
            f"expected row numbers in episode_starts of {path}, got shape {values.shape} of {values.dtype}; "
            "the file is damaged, make it again"
        )
    return values.astype(np.int64)


def _metadata(text: np.ndarray, path: Path) -> _Metadata:
    try:
        stored = json.loads(str(text))
        version = stored["version"]
        if version == VERSION:
            return TypeAdapter(_Metadata).validate_python(stored)
    except (ValueError, TypeError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise MadocError(f"metadata of {path} cannot be read ({reason}); the file is damaged, make it again") from error
    raise MadocError(f"expected file version {VERSION}, got {version} in {path}; use the Madoc that wrote it")
