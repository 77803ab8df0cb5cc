"""A run folder as a report needs it: whatever of it is there."""

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
from jaxtyping import Float
from pydantic import Field, TypeAdapter, ValidationError
from ruamel.yaml import YAML, YAMLError

from madoc.calibration import CalibrationResult, ParameterEstimate
from madoc.calibration.holdout import HoldOut
from madoc.errors import MadocError
from madoc.robots.document import yaml_text
from madoc.runs.files import read_json

Record = TypeVar("Record")


@dataclass(frozen=True)
class MetricLog:
    """The lines of a `metrics.jsonl` as columns; a metric that a line does not have is NaN there.

    Attributes:
        spent: Control steps (or updates) spent, a value a line.
        seconds: Wall-clock time.
        stage: What was being done.
        metrics: By name.
        unit: What `spent` counts.
    """

    spent: Float[np.ndarray, " lines"]
    seconds: Float[np.ndarray, " lines"]
    stage: tuple[str, ...]
    metrics: Mapping[str, Float[np.ndarray, " lines"]]
    unit: str

    def __len__(self) -> int:
        return len(self.stage)


@dataclass(frozen=True)
class Evidence:
    """Held-out stretches of the log beside what the simulator makes of them, before and after.

    Attributes:
        signals: Their names.
        scale: How much each typically changes in a control step.
        time: Seconds since the beginning of a stretch.
        measured: What was logged.
        before: Simulated at mid-range, NaN where that failed; None where no state can be rebuilt to start from.
        after: Simulated at the estimate.
        residual_before: Simulated less measured after one control step, at mid-range.
        residual_after: The same at the estimate.
    """

    signals: tuple[str, ...]
    scale: Float[np.ndarray, " signals"]
    time: Float[np.ndarray, " times"]
    measured: Float[np.ndarray, "stretches times signals"]
    before: Float[np.ndarray, "stretches times signals"] | None
    after: Float[np.ndarray, "stretches times signals"] | None
    residual_before: Float[np.ndarray, "windows signals"] | None
    residual_after: Float[np.ndarray, "windows signals"] | None


@dataclass(frozen=True)
class Embeddings:
    """What a method learnt of which parameters act alike: one vector a parameter."""

    names: tuple[str, ...]
    vectors: Float[np.ndarray, "d latent"]


@dataclass(frozen=True)
class DataUsed:
    """What a spec remembers of the data: number of rows, and a fingerprint of their content."""

    rows: int | None = None
    fingerprint: str = ""


@dataclass(frozen=True)
class RobotFile:
    """The spec file of a robot of one's own: its name and its text."""

    file: str = "its spec file"
    spec: str = ""


@dataclass(frozen=True)
class Spec:
    """What a calibration was asked, as far as a page shows it.

    Attributes:
        task: The robot.
        method: A calibrator, or `auto`.
        seed: Of all randomness.
        parameters: Range of each parameter.
        truth: True values by name, where they are known.
        data: What was calibrated to.
        robot: The robot's own file, if it has one.
        versions: Of the libraries.
        text: All of `spec.json`, as YAML, but for versions and robot.
    """

    task: str = "robot"
    method: str | None = None
    seed: int | None = None
    parameters: dict[str, tuple[float, float]] = field(default_factory=dict)
    truth: dict[str, float] | None = None
    data: DataUsed | None = None
    robot: RobotFile | None = None
    versions: dict[str, str] = field(default_factory=dict)
    text: str = ""


@dataclass(frozen=True)
class PolicyReturn:
    """Mean return of a policy's episodes, its standard deviation, normalized score and mean length."""

    mean: Annotated[float, Field(alias="return")]
    std: Annotated[float, Field(alias="return_std")]
    normalized: float
    length: float


@dataclass(frozen=True)
class Evaluation:
    """Policies in the target: number of episodes of each, and returns by name."""

    episodes: int
    policies: dict[str, PolicyReturn]


@dataclass(frozen=True)
class Run:
    """What a run folder holds. Everything but the folder may be missing.

    Attributes:
        name: Of the folder.
        folder: Of the calibration.
        whole: The folder that was named: the calibration's, or that of `madoc run` around it.
        spec: What the calibration was asked.
        result: What it returned; None while it has not ended.
        status: How it ended; None while it has not.
        sentence: The same in words.
        log: Its metrics.
        evidence: Held-out stretches.
        embeddings: What it learnt of which parameters act alike.
        evaluation: Policies in the target.
    """

    name: str
    folder: Path
    whole: Path
    spec: Spec = field(default_factory=Spec)
    result: CalibrationResult | None = None
    status: str | None = None
    sentence: str = ""
    log: MetricLog | None = None
    evidence: Evidence | None = None
    embeddings: Embeddings | None = None
    evaluation: Evaluation | None = None

    @property
    def parameters(self) -> dict[str, ParameterEstimate]:
        """Estimates by name; empty while there is none."""
        return {} if self.result is None else self.result.parameters

    @property
    def warnings(self) -> list[str]:
        """What to know before trusting the result."""
        return [] if self.result is None else self.result.warnings

    @property
    def holdout(self) -> HoldOut | None:
        """What rows held out say, where there were any."""
        return None if self.result is None else self.result.holdout

    @property
    def error_percent(self) -> float | None:
        """Mean error in % of the ranges, where the truth is known."""
        return self.result.error["mean_percent_of_range"] if self.result is not None and self.result.error else None

    @property
    def method(self) -> str:
        """The method that calibrated: the one that was kept, where several were tried."""
        return self.result.method if self.result is not None else self.spec.method or "an unknown method"

    @cached_property
    def units(self) -> dict[str, str]:
        """Units of signals by name, where the spec of a robot of one's own has them."""
        try:
            spec = YAML(typ="safe").load(self.spec.robot.spec if self.spec.robot else "") or {}
            return {row["name"]: str(row["unit"]) for row in spec["signals"] if "unit" in row}
        except (YAMLError, KeyError, TypeError):
            return {}

    @property
    def truth(self) -> dict[str, float]:
        """True values by name, where they are known."""
        return self.spec.truth or {}

    @cached_property
    def groups(self) -> dict[str, int]:
        """Group of each parameter, from 0; empty where all are one group."""
        groups = [] if self.result is None else self.result.groups
        return {name: index for index, names in enumerate(groups) for name in names} if len(groups) > 1 else {}


def read_run(path: Path) -> Run:
    """Read a run folder: finished, under way, or stopped.

    Raises:
        MadocError: It is none, or a file in it is damaged.
    """
    path = path.expanduser()
    if not path.is_dir():
        raise MadocError(f"there is no run folder {path}; check the path")
    folder = path / "calibration" if (path / "calibration" / "spec.json").exists() else path
    if not (folder / "spec.json").exists():
        raise MadocError(f"{path} holds no calibration: there is no spec.json; name a folder of madoc calibrate or run")
    asked = _object(folder / "spec.json")
    if asked.get("command") == "learn":
        raise MadocError(f"{path} holds a policy, not a calibration; name the run folder it was learnt from")
    shown = {name: value for name, value in asked.items() if name not in ("versions", "robot")}
    spec = _typed(Spec, asked | {"text": yaml_text(shown, width=80)}, folder / "spec.json")
    ended = _object(folder / "result.json")
    result = CalibrationResult.from_json(ended) if "parameters" in ended else None
    method = _folder_of_method(folder, result.holdout.chosen if result and result.holdout else None)
    evaluation = _object(path / "evaluation.json")
    return Run(
        name=path.resolve().name,
        folder=folder,
        whole=path,
        spec=spec,
        result=result,
        status=str(ended["status"]) if "status" in ended else None,
        sentence=str(ended.get("sentence", "")),
        log=read_metrics(method / "metrics.jsonl"),
        evidence=read_evidence(folder / "evidence.npz"),
        embeddings=read_embeddings(method / "embeddings.npz"),
        evaluation=_typed(Evaluation, evaluation, path / "evaluation.json") if evaluation else None,
    )


def read_metrics(path: Path) -> MetricLog | None:
    """The metrics of a run; None where there are none. A last line cut short, as a kill leaves it, is left out.

    Raises:
        MadocError: A line is not JSON.
    """
    if not path.exists():
        return None
    lines = []
    written = path.read_text(encoding="utf-8").splitlines()
    for number, text in enumerate(written, 1):
        try:
            lines.append(json.loads(text))
        except ValueError as error:
            if number < len(written):
                raise MadocError(f"{path}, line {number}, is not JSON ({error}); restore it or delete it") from error
    if not lines:
        return None
    count = "control_steps" if "control_steps" in lines[0] else "updates"
    names = list(dict.fromkeys(name for line in lines for name in line["metrics"]))
    return MetricLog(
        spent=np.array([line[count] for line in lines], dtype=float),
        seconds=np.array([line["seconds"] for line in lines], dtype=float),
        stage=tuple(line["stage"] for line in lines),
        metrics={name: np.array([_number(line["metrics"].get(name)) for line in lines]) for name in names},
        unit=count.replace("_", " "),
    )


def read_evidence(path: Path) -> Evidence | None:
    """Held-out stretches; None where the run held nothing out."""
    arrays = _arrays(path, "signals", "scale", "time", "measured")
    if arrays is None:
        return None
    simulated = ("before", "after", "residual_before", "residual_after")
    return Evidence(
        tuple(str(name) for name in arrays["signals"]),
        *(np.asarray(arrays[name], float) for name in ("scale", "time", "measured")),
        *(np.asarray(arrays[name], float) if name in arrays else None for name in simulated),
    )


def read_embeddings(path: Path) -> Embeddings | None:
    """What was learnt of which parameters act alike; None where the method learns no such thing."""
    arrays = _arrays(path, "names", "vectors")
    if arrays is None:
        return None
    return Embeddings(tuple(str(name) for name in arrays["names"]), np.asarray(arrays["vectors"], float))


def _folder_of_method(folder: Path, chosen: str | None) -> Path:
    """Where the method's own log lies: where several are tried, in the folder of the kept, or of the latest, one."""
    if chosen is not None:
        return folder / chosen
    logs = [folder / "metrics.jsonl", *folder.glob("*/metrics.jsonl")]
    return max((log for log in logs if log.exists()), key=lambda log: log.stat().st_mtime, default=logs[0]).parent


def _typed(kind: type[Record], fields: dict[str, object], path: Path) -> Record:
    """A record of a file's fields.

    Raises:
        MadocError: A field is not what it should be.
    """
    try:
        return TypeAdapter(kind).validate_python(fields)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise MadocError(f"{path} is damaged ({place}: {first['msg']}); restore it or delete it") from error


def _object(path: Path) -> dict[str, object]:
    """A JSON object; empty where there is no such file.

    Raises:
        MadocError: It is damaged.
    """
    if not path.exists():
        return {}
    found = read_json(path)
    if not isinstance(found, dict):
        raise MadocError(f"expected a JSON object in {path}, got {type(found).__name__}; restore it or delete it")
    return found


def _arrays(path: Path, *needed: str) -> dict[str, np.ndarray] | None:
    """The arrays of an npz, or None where there is no such file.

    Raises:
        MadocError: It is damaged, or an array is missing.
    """
    if not path.exists():
        return None
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = dict(file)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise MadocError(f"{path} is damaged ({error}); restore it or delete it") from error
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise MadocError(f"expected the array {missing[0]} in {path}, got {', '.join(arrays)}; restore or delete it")
    return arrays


def _number(value: float | None) -> float:
    return np.nan if value is None else float(value)
