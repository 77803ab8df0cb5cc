"""A run folder as a report needs it: everything that is there, finished or not."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from madoc.calibration.holdout import HoldOut
from madoc.calibration.result import CalibrationResult, ParameterEstimate
from madoc.data.archives import unpack
from madoc.errors import MadocError
from madoc.report.records import EvaluationRecord, SpecRecord, read_object, read_record, read_spec
from madoc.robots.document import yaml_text
from madoc.runs.files import read_bytes
from madoc.runs.machine import read_peak


@dataclass(frozen=True)
class StageCost:
    """What all epochs of a stage took: wall-clock time in s, control steps (or updates), and their number."""

    seconds: float
    spent: float
    epochs: int


@dataclass(frozen=True)
class MetricLog:
    """The lines of a `metrics.jsonl` as columns; a metric is NaN at lines that do not have it.

    Attributes:
        spent: Control steps (or updates) spent before the end of each line's epoch.
        seconds: Wall-clock time, s.
        stage: What the epoch did.
        metrics: Columns by name.
        unit: Unit of `spent`.
    """

    spent: Float[np.ndarray, " lines"]
    seconds: Float[np.ndarray, " lines"]
    stage: tuple[str, ...]
    metrics: Mapping[str, Float[np.ndarray, " lines"]]
    unit: str

    def __len__(self) -> int:
        return len(self.stage)

    def by_stage(self) -> dict[str, StageCost]:
        """The cost of each stage; what came before the first line belongs to the first stage."""
        seconds, spent = np.diff(self.seconds, prepend=0.0), np.diff(self.spent, prepend=0.0)
        rows = {name: np.array([stage == name for stage in self.stage]) for name in dict.fromkeys(self.stage)}
        return {
            name: StageCost(float(seconds[own].sum()), float(spent[own].sum()), int(own.sum()))
            for name, own in rows.items()
        }


@dataclass(frozen=True)
class Evidence:
    """Held-out runs beside their simulation in the model as given (before) and at the estimate (after).

    Runs are NaN behind their end, and simulations once they have failed; these are None where no position is known.

    Attributes:
        signals: Names of the signals.
        names: Names of the runs.
        fitted: Number of rows to which the start of each run was fitted; 0 where it is the first logged state.
        scale: Typical change of each signal in a stride of rows (`data.dataset.stride`), in its unit.
        time: Time since the beginning of a run, s.
        measured: What was logged.
        before: Simulated in the model as given.
        after: Simulated at the estimate.
        residual_before: Simulated minus measured after a stride of rows, in the model as given.
        residual_after: The same at the estimate.
    """

    signals: tuple[str, ...]
    names: tuple[str, ...]
    fitted: int
    scale: Float[np.ndarray, " signals"]
    time: Float[np.ndarray, " times"]
    measured: Float[np.ndarray, "runs times signals"]
    before: Float[np.ndarray, "runs times signals"] | None
    after: Float[np.ndarray, "runs times signals"] | None
    residual_before: Float[np.ndarray, "rows signals"] | None
    residual_after: Float[np.ndarray, "rows signals"] | None


@dataclass(frozen=True)
class Embeddings:
    """What a method learnt about which parameters act alike: a vector for each parameter."""

    names: tuple[str, ...]
    vectors: Float[np.ndarray, "d latent"]


@dataclass(frozen=True)
class Run:
    """The content of a run folder; everything but the spec may be missing.

    Attributes:
        name: Name of the folder.
        folder: Folder of the calibration.
        whole: The folder that the user named: the calibration's, or that of `madoc run` around it.
        spec: What the calibration was asked to do.
        spec_text: All of its `spec.json` but for versions and robot, as YAML.
        result: None while it has not ended, as `status`, and `sentence`, the status in words.
    """

    name: str
    folder: Path
    whole: Path
    spec: SpecRecord = field(default_factory=SpecRecord)
    spec_text: str = ""
    result: CalibrationResult | None = None
    status: str | None = None
    sentence: str = ""
    log: MetricLog | None = None
    evidence: Evidence | None = None
    embeddings: Embeddings | None = None
    evaluation: EvaluationRecord | None = None
    peak_memory: int | None = None

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
        """How the estimate does on held-out data, where it was judged."""
        return None if self.result is None else self.result.holdout

    @property
    def error_percent(self) -> float | None:
        """Mean error in % of the ranges, where the truth is known."""
        return self.result.error["mean_percent_of_range"] if self.result is not None and self.result.error else None

    @property
    def method(self) -> str:
        """The method that calibrated: the one that was kept, where several were tried."""
        return self.result.method if self.result is not None else self.spec.method or "an unknown method"

    @property
    def truth(self) -> dict[str, float]:
        """True values by name, where they are known."""
        return self.spec.truth or {}

    @cached_property
    def units(self) -> dict[str, str]:
        """Units of signals by name, where the spec of a user's own robot has them."""
        try:
            spec = YAML(typ="safe").load(str((self.spec.robot or {})["spec"]))
            return {row["name"]: str(row["unit"]) for row in spec["signals"] if "unit" in row}
        except (YAMLError, KeyError, TypeError):
            return {}

    @cached_property
    def groups(self) -> dict[str, int]:
        """Group of each parameter, from 0; empty where all are in one group, or each in its own."""
        groups = self.result.groups if self.result is not None and self.result.grouped else []
        return {name: index for index, names in enumerate(groups) for name in names}

    def colour(self, parameter: str) -> str:
        """Class in the style sheet of the colour of a parameter's group."""
        return f"g{self.groups.get(parameter, 0) % 8}"


def read_run(path: Path) -> Run:
    """Read a run folder: finished, under way, or stopped.

    Raises:
        MadocError: The folder holds no calibration, or a file in it is damaged.
    """
    path = path.expanduser()
    if not path.is_dir():
        raise MadocError(f"there is no run folder {path}; check the path")
    folder = path / "calibration" if (path / "calibration" / "spec.json").exists() else path
    if not (folder / "spec.json").exists():
        raise MadocError(f"{path} holds no calibration: there is no spec.json; name a folder of madoc calibrate or run")
    spec = read_spec(folder)
    if spec.command == "learn":
        raise MadocError(f"{path} holds a policy, not a calibration; name the run folder it was learnt from")
    asked = read_object(folder / "spec.json").items()
    ended = read_object(folder / "result.json") if (folder / "result.json").exists() else {}
    result = CalibrationResult.from_json(ended) if "parameters" in ended else None
    evaluation = path / "evaluation.json"
    return Run(
        name=path.resolve().name,
        folder=folder,
        whole=path,
        spec=spec,
        spec_text=yaml_text({key: value for key, value in asked if key not in ("versions", "robot")}, width=80),
        result=result,
        status=str(ended["status"]) if "status" in ended else None,
        sentence=str(ended.get("sentence", "")),
        log=read_metrics(folder / "metrics.jsonl"),
        evidence=_read_evidence(folder / "evidence.npz"),
        embeddings=_read_embeddings(folder / "embeddings.npz"),
        evaluation=read_record(EvaluationRecord, evaluation) if evaluation.exists() else None,
        peak_memory=read_peak(folder),
    )


def read_metrics(path: Path) -> MetricLog | None:
    """The metrics of a run; None where there are none. A last line that a kill has cut short is left out.

    Raises:
        MadocError: A line is not JSON.
    """
    if not path.exists():
        return None
    lines = []
    written = read_bytes(path).decode().splitlines()
    for number, text in enumerate(written, 1):
        try:
            lines.append(json.loads(text))
        except ValueError as error:
            if number < len(written):
                raise MadocError(f"{path}, line {number}, is not JSON ({error}); restore it or delete it") from error
    if not lines:
        return None
    count = "control_steps" if "control_steps" in lines[0] else "updates"
    names = dict.fromkeys(name for line in lines for name in line["metrics"])
    return MetricLog(
        spent=np.array([line[count] for line in lines], dtype=float),
        seconds=np.array([line["seconds"] for line in lines], dtype=float),
        stage=tuple(line["stage"] for line in lines),
        metrics={name: np.array([line["metrics"].get(name) for line in lines], dtype=float) for name in names},
        unit=count.replace("_", " "),
    )


def _read_evidence(path: Path) -> Evidence | None:
    """Held-out runs; None where the run held nothing out."""
    arrays = read_arrays(path, "signals", "scale", "time", "measured")
    if arrays is None:
        return None
    simulated = ("before", "after", "residual_before", "residual_after")
    return Evidence(
        tuple(map(str, arrays["signals"])),
        tuple(map(str, arrays.get("names", range(1, 1 + len(arrays["measured"]))))),
        int(arrays.get("fitted", 0)),
        *(np.asarray(arrays[name], float) for name in ("scale", "time", "measured")),
        *(np.asarray(arrays[name], float) if name in arrays else None for name in simulated),
    )


def _read_embeddings(path: Path) -> Embeddings | None:
    """The embeddings of parameters; None where the method learns none."""
    arrays = read_arrays(path, "names", "vectors")
    if arrays is None:
        return None
    return Embeddings(tuple(map(str, arrays["names"])), np.asarray(arrays["vectors"], float))


def read_arrays(path: Path, *needed: str) -> dict[str, np.ndarray] | None:
    """The arrays of an npz file, or None where there is none.

    Raises:
        MadocError: The file is damaged, or an array is missing.
    """
    if not path.exists():
        return None
    arrays = unpack(path, "restore it or delete it")
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise MadocError(f"expected the array {missing[0]} in {path}, got {', '.join(arrays)}; restore or delete it")
    return arrays
