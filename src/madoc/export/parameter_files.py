"""A calibration as YAML files: the patch, ranges to randomize in, parameters that `mujoco.sysid` reads."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from madoc.calibration.result import ParameterEstimate
from madoc.identification.information import NORMAL_95
from madoc.parameters import Parameter
from madoc.robots.document import yaml_text
from madoc.runs.files import read_bytes, replacing
from madoc.simulation.mjcf import Change

OF_PATCH = "What a calibration changed in the model, and how sure it is."
"""The first line of a patch."""
OF_RANGES = (
    "Ranges to randomize in; each is a normal distribution cut off at low and high, whose std is that of its 95 % "
    "interval where it has one."
)
"""The first line of a file of ranges; an interval is wider than a patch's std says where the model may lack a term."""


@dataclass(frozen=True)
class Exported:
    """One parameter as it is exported.

    Attributes:
        parameter: Its field, elements and range.
        row: Its estimate.
        own: The values in the robot's own model, one for each element.
        left_out: A clause with what leaving it as it is there costs over held-out runs; empty where that is not known.
    """

    parameter: Parameter
    row: ParameterEstimate
    own: tuple[float, ...]
    left_out: str = ""


def save_patch(
    path: Path,
    exported: Sequence[Exported],
    provenance: Mapping[str, object],
    *,
    changes: Sequence[Change],
    stepping: Mapping[str, object],
) -> None:
    """Write only what the calibration changed: parameters with unit and interval, and attributes of the model.

    `provenance` says where the estimate comes from, `stepping` how the model must be stepped to move as it was
    calibrated to.
    """
    content = {
        "provenance": _without_empty(provenance),
        "stepping": dict(stepping),
        "parameters": [_patched(each) for each in exported],
        "model_changes": [
            asdict(change) | {"old": _single(change.old), "new": _single(change.new)} for change in changes
        ],
    }
    _write(path, OF_PATCH, content)


def is_patch(path: Path) -> bool:
    """Whether a file is one that `save_patch` wrote."""
    try:
        return read_bytes(path).decode().startswith(f"# {OF_PATCH}")
    except ValueError:  # it cannot be read, or is no text
        return False


def save_randomization(
    path: Path,
    exported: Sequence[Exported],
    provenance: Mapping[str, object],
    covariance: list[list[float]] | None,
    *,
    independent: str = "",
) -> None:
    """Write, for each parameter, a range and a truncated normal distribution to draw it from in training.

    The range is the 95 % interval where the method gave one, else 1.96 standard deviations to either side, within the
    range that was searched. The covariance, where the method gave one, is for drawing parameters together;
    `independent` says what drawing each by itself costs.
    """
    content: dict[str, object] = {
        "provenance": _without_empty(provenance),
        "parameters": {each.parameter.name: _distribution(each) for each in exported},
    }
    if independent:
        content["drawn_independently"] = independent
    if covariance is not None:
        content["covariance"] = {"order": [each.parameter.name for each in exported], "rows": covariance}
    _write(path, OF_RANGES, content)


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


def _patched(exported: Exported) -> dict[str, object]:
    """A parameter's entry in the patch; its old values are several where elements that now share one differed."""
    parameter, row = exported.parameter, exported.row
    in_model = parameter.kind.in_model
    fields = {
        "parameter": parameter.name,
        "field": parameter.field,
        "element": _single(parameter.elements) if parameter.elements else None,
        "old": exported.own[0] if len(set(exported.own)) == 1 else list(exported.own),
        "new": row.estimate,
        "unit": row.unit,
        "std": row.std,
        "interval_95": row.interval,
        "searched": [row.low, row.high],
        "applied": None if in_model else f"around the model, which has no place for it{exported.left_out}",
    }
    return _without_empty(fields)


def _distribution(exported: Exported) -> dict[str, object]:
    parameter, row = exported.parameter, exported.row
    low, high = row.interval or (row.estimate - NORMAL_95 * row.std, row.estimate + NORMAL_95 * row.std)
    named = {"field": parameter.field, "element": _single(parameter.elements) if parameter.elements else None}
    return _without_empty(named) | {
        "low": float(min(max(low, row.low), row.estimate)),
        "high": float(max(min(high, row.high), row.estimate)),
        "mean": row.estimate,
        "std": row.half_width / NORMAL_95,
        "unit": row.unit,
        "from": "95 % interval" if row.interval else "1.96 standard deviations",
    }


def _without_empty(fields: Mapping[str, object]) -> dict[str, object]:
    return {name: value for name, value in fields.items() if value not in (None, {}, [])}


def _single(values: Sequence[object]) -> object:
    """One value as itself, several as a list."""
    return values[0] if len(values) == 1 else list(values)


def _write(path: Path, comment: str, content: object) -> None:
    with replacing(path) as stream:
        stream.write(f"# {comment}\n{yaml_text(content)}".encode())
