"""The files of a run folder as types: `spec.json`, `evaluation.json` and `summary.json`."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from madoc.data.disturbance import Disturbance
from madoc.errors import MadocError
from madoc.policies import ErrorCost, OverDraws
from madoc.runs.files import read_json

Record = TypeVar("Record")


@dataclass(frozen=True)
class DataRecord:
    """The data of a run, and how it was read.

    Attributes:
        paths: Paths relative to the run folder where the data lies beside it, else absolute, or a Minari id.
        format: A name in `data.FORMATS`; None where the reader was chosen by the file's content.
        clip_actions: Whether actions outside their ranges were clipped.
        max_transitions: Largest number of rows that were kept.
        disturbance: What was done to the data after it had been read.
        rows: Number of rows after all of this.
        fingerprint: Checksum of these rows.
    """

    paths: tuple[str, ...] = ()
    format: str | None = None
    clip_actions: bool = False
    max_transitions: int | None = None
    disturbance: Disturbance = field(default_factory=Disturbance)
    rows: int = 0
    fingerprint: str = ""


@dataclass(frozen=True)
class SpecRecord:
    """The `spec.json` of a calibration or of a policy, as far as later stages and reports read it.

    Attributes:
        command: `calibrate`, `learn` or `run`; empty where there is no such file.
        parameters: Range of each calibrated parameter, or its value where a policy was learnt.
        at: Where a policy was learnt: `calibrated`, `truth`, `midrange`, ...; None of a calibration.
        truth: True values by name, where they are known.
        holdout: Share of the rows that was held out; None where the result was not judged.
        robot: Name and text of the spec file of a user's own robot, and its model; None for one of Madoc's.
        versions: Versions of the packages that can change a result's last bits.
    """

    command: str = ""
    task: str = "robot"
    method: str | None = None
    physics: str | None = None
    parameters: dict[str, tuple[float, float] | float] = field(default_factory=dict)
    seed: int | None = None
    at: str | None = None
    truth: dict[str, float] | None = None
    holdout: float | None = None
    data: DataRecord | None = None
    robot: dict[str, object] | None = None
    versions: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class EvaluationRecord:
    """The content of `evaluation.json`.

    Attributes:
        episodes: Number of episodes of each policy.
        seed: Seed of the starts.
        policies: In the target, by name: `return` and `return_std` over episodes, `normalized` score and mean `length`;
            empty where the target is not known.
        at_estimate: The same in the calibrated simulator; empty without a calibration.
        over_draws: The return in systems drawn from the calibrated distribution, by name.
        error_costs: What an error of half an interval of each parameter costs, by name of the policy; not of
            yardsticks.
        calibrated_percent_of_truth: Return of the calibrated policy in percent of that learnt at the truth, if known.
    """

    task: str
    physics: str
    episodes: int
    seed: int
    policies: dict[str, dict[str, float]]
    at_estimate: dict[str, dict[str, float]] = field(default_factory=dict)
    over_draws: dict[str, OverDraws] = field(default_factory=dict)
    error_costs: dict[str, dict[str, ErrorCost]] = field(default_factory=dict)
    calibrated_percent_of_truth: float | None = None

    def to_json(self) -> dict[str, object]:
        """All fields that are not None."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@dataclass(frozen=True)
class Summary:
    """The content of `summary.json`: how a whole run ended.

    Attributes:
        name: The robot and the quality of its data, as the user named them.
        status: `finished`, or how the stage ended that was interrupted or diverged.
        data: `transitions` and `fingerprint`.
        calibration: The result, as `CalibrationResult.to_json` writes it.
        policies: How the learning of each policy ended, by name.
        evaluation: None where the run stopped before.
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
        """All fields."""
        return asdict(self) | {"evaluation": self.evaluation and self.evaluation.to_json()}


def read_object(path: Path) -> dict[str, object]:
    """The content of a JSON file that holds an object.

    Raises:
        MadocError: The file is missing or damaged, or holds something else.
    """
    content = read_json(path)
    if not isinstance(content, dict):
        raise MadocError(f"expected a JSON object in {path}, got {type(content).__name__}; restore it or delete it")
    return content


def read_record(kind: type[Record], path: Path) -> Record:
    """A record from a JSON file; keys that the record does not have are ignored.

    Raises:
        MadocError: As `read_object`, or a value has another type than the record's.
    """
    try:
        return TypeAdapter(kind).validate_python(read_object(path))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise MadocError(f"{path} is damaged ({place}: {first['msg']}); restore it or delete it") from error


def read_spec(folder: Path) -> SpecRecord:
    """The `spec.json` of a folder; the defaults where there is none, and of `madoc run` its command alone."""
    path = folder / "spec.json"
    if not path.exists():
        return SpecRecord()
    return SpecRecord("run") if read_object(path).get("command") == "run" else read_record(SpecRecord, path)


def stored_path(path: Path, folder: Path) -> str:
    """A path as the spec in `folder` stores it: relative to the folder beside it, so that both can be moved."""
    target, parent = path.expanduser().resolve(), folder.expanduser().resolve().parent
    return f"../{target.relative_to(parent)}" if target.is_relative_to(parent) else str(target)


def restored_path(path: str, folder: Path) -> str:
    """The path that `stored_path` wrote; the id of a Minari dataset stays what it is."""
    is_file = path.startswith(("/", "..")) or (folder / path).exists()
    return str(folder / path) if is_file else path
