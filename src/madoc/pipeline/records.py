"""What a run folder remembers, as types: `spec.json`, `evaluation.json` and `summary.json`."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from madoc.data import Disturbance
from madoc.errors import MadocError
from madoc.pipeline.folders import restored_path
from madoc.pipeline.orders import Reading, Source
from madoc.runs.files import read_json

Record = TypeVar("Record")


@dataclass(frozen=True)
class DataRecord:
    """The data of a run, and how it was read.

    Attributes:
        paths: As `folders.stored_path` writes them, or the id of a Minari dataset.
        format: A name in `data.FORMATS`; None where the content said it.
        clip_actions: Whether actions outside their ranges were clipped.
        max_transitions: The most rows that were kept.
        disturbance: What was put into the data once it was read.
        rows: How many there were then.
        fingerprint: Their checksum.
    """

    paths: tuple[str, ...]
    format: str | None = None
    clip_actions: bool = False
    max_transitions: int | None = None
    disturbance: Disturbance = field(default_factory=Disturbance)
    rows: int = 0
    fingerprint: str = ""

    def source(self, folder: Path) -> Source:
        """Where the data of the run in `folder` is, also after both have been moved."""
        paths = []
        for path in self.paths:
            stored = path.startswith(("/", "..")) or (folder / path).exists()  # else the id of a Minari dataset
            paths.append(str(restored_path(path, folder)) if stored else path)
        reading = Reading(self.format, self.clip_actions, self.disturbance)
        return Source(tuple(paths), self.max_transitions, reading)


@dataclass(frozen=True)
class SpecRecord:
    """What later stages read of the `spec.json` of a calibration or of a policy; what it lacks has the defaults.

    Attributes:
        command: `calibrate`, `learn` or `run`; empty where there is no such file.
        task: Name of the robot.
        physics: `legacy` or `modern`.
        parameters: Names of the calibrated parameters, with their ranges or values.
        seed: Of all randomness.
        truth: The target's physical values by name, where they are known.
        holdout: Share of the rows that was held out; None where the result was not judged.
        data: The logged data.
        robot: What a robot of one's own is made of again; None for one of Madoc's.
        versions: Versions of what decides a run's bits.
    """

    command: str = ""
    task: str = ""
    physics: str | None = None
    parameters: Mapping[str, object] = field(default_factory=dict)
    seed: int | None = None
    truth: dict[str, float] | None = None
    holdout: float | None = None
    data: DataRecord | None = None
    robot: dict[str, object] | None = None
    versions: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class EvaluationRecord:
    """What `evaluation.json` holds.

    Attributes:
        task: Name of the robot.
        physics: `legacy` or `modern`.
        episodes: How many were run for each policy.
        seed: Of their starts.
        policies: By name, the mean return, its deviation over episodes, the normalized score and the mean length.
        calibrated_percent_of_truth: Return of the calibrated policy in percent of that learnt at the truth, if known.
    """

    task: str
    physics: str
    episodes: int
    seed: int
    policies: dict[str, dict[str, float]]
    calibrated_percent_of_truth: float | None = None

    def to_json(self) -> dict[str, object]:
        """Its fields; the share is left out where it is not known."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@dataclass(frozen=True)
class Summary:
    """What `summary.json` holds: how a whole run ended.

    Attributes:
        name: As it was asked.
        status: `finished`, or how the stage ended that was interrupted or diverged.
        sentence: The status in words.
        task: Name of the robot.
        physics: `legacy` or `modern`.
        seed: Of all randomness.
        data: `transitions` and `fingerprint`.
        calibration: The result, as `CalibrationResult.to_json` writes it.
        policies: By name, how the learning of each ended.
        evaluation: The policies in the target; None where the target is not known.
    """

    name: str
    status: str
    sentence: str
    task: str
    physics: str
    seed: int
    data: dict[str, int | str]
    calibration: dict[str, object]
    policies: dict[str, dict[str, object]] = field(default_factory=dict)
    evaluation: EvaluationRecord | None = None

    def to_json(self) -> dict[str, object]:
        """Its fields."""
        return asdict(self) | {"evaluation": None if self.evaluation is None else self.evaluation.to_json()}


def read_record(kind: type[Record], path: Path) -> Record:
    """A record from a JSON file; what the file says besides is ignored.

    Raises:
        MadocError: The file is missing or damaged, or says something of another type.
    """
    try:
        return TypeAdapter(kind).validate_python(read_json(path))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the whole"
        raise MadocError(f"{path} cannot be read: {place}: {first['msg']}; restore it from a copy") from error


def read_spec(folder: Path) -> SpecRecord:
    """The `spec.json` of a folder; one with nothing in it where there is no such file."""
    return read_record(SpecRecord, folder / "spec.json") if (folder / "spec.json").exists() else SpecRecord()
