"""A calibration as YAML files: the patch, ranges to randomize in, parameters that `mujoco.sysid` reads."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from madoc.calibration.result import ParameterEstimate
from madoc.parameters import FIELDS, Parameter
from madoc.robots.document import yaml_text
from madoc.runs.files import replacing
from madoc.simulation.mjcf import Change

NORMAL_95 = 1.959963984540054
"""Standard deviations to either side of the mean that hold 95 % of a normal distribution."""


@dataclass(frozen=True)
class Provenance:
    """Where an estimate comes from.

    Attributes:
        run: Name of the run folder.
        method: Name of the calibrator.
        seed: The seed of all its randomness.
        data: Paths, rows and fingerprint of the log, as far as they are known.
        versions: Versions of the packages that decide the result's bits.
        verdict: The verdict on held-out rows, where there were any.
        warnings: What to know before trusting it, one sentence each.
    """

    run: str
    method: str
    seed: int
    data: Mapping[str, object]
    versions: Mapping[str, str]
    verdict: Mapping[str, object] | None
    warnings: Sequence[str]

    def to_dict(self) -> dict[str, object]:
        """The fields as they are written to YAML; what is not known is left out."""
        fields = {
            "run": self.run,
            "method": self.method,
            "seed": self.seed,
            "verdict": None if self.verdict is None else dict(self.verdict),
            "data": dict(self.data),
            "versions": dict(self.versions),
            "warnings": list(self.warnings),
        }
        return {name: value for name, value in fields.items() if value not in (None, {}, [])}


@dataclass(frozen=True)
class Exported:
    """One parameter as it is exported.

    Attributes:
        parameter: Its field, elements and range.
        row: Its estimate.
        own: The values in the robot's own model, one for each element.
    """

    parameter: Parameter
    row: ParameterEstimate
    own: tuple[float, ...]

    @property
    def old(self) -> float | list[float]:
        """The model's own value: one number, or several where elements that now share a value had different ones."""
        return self.own[0] if len(set(self.own)) == 1 else list(self.own)


def save_patch(
    path: Path,
    exported: Sequence[Exported],
    provenance: Provenance,
    *,
    changes: Sequence[Change],
    stepping: Mapping[str, object],
) -> None:
    """Write only what the calibration changed: by parameter with unit and interval, and by attribute of the model.

    Args:
        path: The file.
        exported: The estimates.
        provenance: Where they come from.
        changes: Attributes in which the written model differs from the robot's own.
        stepping: How the model must be stepped to move as it was calibrated to.
    """
    attributes = [
        {"element": change.element, "attribute": change.attribute, "old": _flat(change.old), "new": _flat(change.new)}
        for change in changes
    ]
    content = {
        "provenance": provenance.to_dict(),
        "stepping": dict(stepping),
        "parameters": [_patched(each) for each in exported],
        "model_changes": attributes,
    }
    _write(path, "What a calibration changed in the model, and how sure it is.", content)


def _patched(exported: Exported) -> dict[str, object]:
    """A parameter's line of the patch."""
    parameter, row = exported.parameter, exported.row
    elements = list(parameter.elements)
    in_model = FIELDS[parameter.field].in_model
    fields: dict[str, object] = {
        "parameter": parameter.name,
        "field": parameter.field,
        "element": elements[0] if len(elements) == 1 else elements or None,
        "old": exported.old,
        "new": row.estimate,
        "unit": row.unit,
        "std": row.std,
        "interval_95": row.interval,
        "searched": [row.low, row.high],
        "applied": None if in_model else "around the model, which has no place for it",
    }
    return {name: value for name, value in fields.items() if value is not None}


def save_randomization(
    path: Path, exported: Sequence[Exported], provenance: Provenance, covariance: list[list[float]] | None
) -> None:
    """Write, for each parameter, a range and a truncated normal distribution to draw it from in training.

    The range is the 95 % interval where the method gave one, else 1.96 deviations to either side, within what was
    searched; the covariance, where it is known, says which parameters to draw together.
    """
    content: dict[str, object] = {
        "provenance": provenance.to_dict(),
        "parameters": {each.parameter.name: _distribution(each.row) for each in exported},
    }
    if covariance is not None:
        content["covariance"] = {"order": [each.parameter.name for each in exported], "rows": covariance}
    _write(path, "Ranges to randomize in; each is a normal distribution cut off at low and high.", content)


def save_sysid_parameters(path: Path, exported: Sequence[Exported]) -> None:
    """Write the parameters as `mujoco.sysid.ParameterDict.load_from_disk` reads them."""
    rows = {
        each.parameter.name: {
            "name": each.parameter.name,
            "nominal": [float(sum(each.own) / len(each.own))],
            "min_value": [float(each.row.low)],
            "max_value": [float(each.row.high)],
            "value": [each.row.estimate],
            "frozen": False,
        }
        for each in exported
    }
    _write(path, "Parameters for mujoco.sysid: ParameterDict.load_from_disk(path).", rows)


def _distribution(row: ParameterEstimate) -> dict[str, object]:
    low, high = row.interval or (row.estimate - NORMAL_95 * row.std, row.estimate + NORMAL_95 * row.std)
    return {
        "low": float(min(max(low, row.low), row.estimate)),
        "high": float(max(min(high, row.high), row.estimate)),
        "mean": row.estimate,
        "std": row.std,
        "unit": row.unit,
        "from": "95 % interval" if row.interval else "1.96 standard deviations",
    }


def _flat(values: list[float]) -> float | list[float]:
    """A list of one number as that number."""
    return values[0] if len(values) == 1 else values


def _write(path: Path, comment: str, content: object) -> None:
    with replacing(path) as stream:
        stream.write(f"# {comment}\n{yaml_text(content)}".encode())
