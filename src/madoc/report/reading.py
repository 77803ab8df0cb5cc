"""A run folder as a report needs it: whatever of it is there."""

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from ruamel.yaml import YAML, YAMLError

from madoc.errors import MadocError
from madoc.runs.files import read_json


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
class Run:
    """What a run folder holds. Everything but the folder may be missing.

    Attributes:
        name: Of the folder.
        folder: Of the calibration.
        whole: The folder that was named: the calibration's, or that of `madoc run` around it.
        spec: What the calibration was asked.
        result: How it ended.
        log: Its metrics.
        evidence: Held-out stretches.
        embeddings: What it learnt of which parameters act alike.
        evaluation: Policies in the target.
    """

    name: str
    folder: Path
    whole: Path
    spec: dict[str, Any] = field(default_factory=dict)
    result: dict[str, Any] = field(default_factory=dict)
    log: MetricLog | None = None
    evidence: Evidence | None = None
    embeddings: Embeddings | None = None
    evaluation: dict[str, Any] | None = None

    @cached_property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Estimates by name; empty while there is none."""
        return self.result.get("parameters", {})

    @property
    def method(self) -> str:
        """What calibrated: the method that was kept, where several were tried."""
        return str(self.result.get("method") or self.spec.get("method", "an unknown method"))

    @cached_property
    def units(self) -> dict[str, str]:
        """Units of signals by name, as far as the spec of a robot of one's own says them."""
        robot = self.spec.get("robot") or {}
        try:
            spec = YAML(typ="safe").load(robot.get("spec", "")) or {}
            return {row["name"]: str(row["unit"]) for row in spec["signals"] if "unit" in row}
        except (YAMLError, KeyError, TypeError):
            return {}

    @cached_property
    def truth(self) -> dict[str, float]:
        """True values by name, as far as they are known."""
        return self.spec.get("truth") or {}

    @cached_property
    def groups(self) -> dict[str, int]:
        """Group of each parameter, from 0; empty where all are one group."""
        groups = self.result.get("groups", [])
        if len(groups) < 2:
            return {}
        return {name: index for index, names in enumerate(groups) for name in names}


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
    spec = _object(folder / "spec.json")
    if spec.get("command") == "learn":
        raise MadocError(f"{path} holds a policy, not a calibration; name the run folder it was learnt from")
    result = _object(folder / "result.json")
    method = _folder_of_method(folder, (result.get("holdout") or {}).get("chosen"))
    return Run(
        name=path.resolve().name,
        folder=folder,
        whole=path,
        spec=spec,
        result=result,
        log=read_metrics(method / "metrics.jsonl"),
        evidence=read_evidence(folder / "evidence.npz"),
        embeddings=read_embeddings(method / "embeddings.npz"),
        evaluation=_object(path / "evaluation.json") or None,
    )


def read_metrics(path: Path) -> MetricLog | None:
    """The metrics of a run; None where there are none. A last line cut short, as a kill leaves it, is left out.

    Raises:
        MadocError: A line is not JSON.
    """
    if not path.exists():
        return None
    lines: list[dict[str, Any]] = []
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


def _object(path: Path) -> dict[str, Any]:
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
