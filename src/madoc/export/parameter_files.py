"""A calibration as files of parameters: the patch, ranges to randomize in, and what mujoco.sysid and Rhoban/bam read.

BAM's parameters are read by its MuJoCo and mjlab actuators and by Isaac Lab. Its equations are ours: duty =
clip(error_gain · kp · (target - q), ±max_pwm), current = (duty · vin - kt · ω) / R, torque = kt · current, and friction
by model M6, which has M1 to M5 in it (`callbacks.friction_limit`). A factor on the torque is a smaller resistance and a
larger current. Where a joint is driven faster than its supply could, BAM lets the current past its limit and Madoc does
not.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from madoc.calibration.result import ParameterEstimate
from madoc.identification.information import NORMAL_95
from madoc.parameters import Parameter
from madoc.robots.document import yaml_text
from madoc.runs.files import read_bytes, replacing, write_json
from madoc.simulation.configuration import JointDrive
from madoc.simulation.mjcf import Change

OF_PATCH = "What a calibration changed in the model, and how sure it is."
"""The first line of a patch."""
OF_RANGES = (
    "Ranges to randomize in; each is a normal distribution cut off at low and high, whose std is that of its 95 % "
    "interval where it has one."
)
"""The first line of a file of ranges; an interval is wider than a patch's std says where the model may lack a term."""

ACTUATOR = "mx64"
"""BAM's class of a drive with a plain position loop and no current limit, in all of its versions. The numbers of a
firmware are attributes of such an object, which its `load_model` does not read from the file, as Isaac Lab does."""
_FRICTION = {
    "stribeck": "friction_stribeck",
    "stribeck_speed": "dtheta_stribeck",
    "stribeck_exponent": "alpha",
    "load_motor": "load_friction_motor",
    "load_external": "load_friction_external",
    "stribeck_load_motor": "load_friction_motor_stribeck",
    "stribeck_load_external": "load_friction_external_stribeck",
    "quadratic_motor": "load_friction_motor_quad",
    "quadratic_external": "load_friction_external_quad",
}
"""BAM's names of the terms of friction, by ours; the units are the same."""


@dataclass(frozen=True)
class Exported:
    """One parameter as it is exported: its estimate, and its `own` values in the robot's model, one for each element.

    `left_out` is a clause with what leaving it as it is there costs over held-out runs; empty where that is not known.
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


def bam_files(folder: Path, drives: Sequence[JointDrive]) -> list[Path]:
    """Where the parameters of each drive are left."""
    names = [re.sub(r"[^A-Za-z0-9_.-]", "_", drive.name) for drive in drives]
    if len({*names}) < len(names):
        names = [f"{name}-{at}" for at, name in enumerate(names)]
    return [folder / f"bam-{name}.json" for name in names]


def save_bam(path: Path, drive: JointDrive, delay: float, lag: float = 0.0) -> None:
    """Write the parameters of one drive, its joint's friction and armature, and what BAM cannot say of them.

    Friction is BAM's `m1` where MuJoCo's own elements say it, else `m6`: Isaac Lab reads neither `m3` nor `m4`.
    The delay is that from a command to its effect, the lag the time constant with which the command is followed, s.
    """
    of, strength = drive.numbers, drive.numbers["strength"]
    content = {
        "model": "m6" if drive.friction else "m1",
        "actuator": ACTUATOR,
        "kt": of["kt"],
        "R": of["resistance"] / strength,
        "armature": drive.armature,
        "q_offset": -drive.zero,
        "command_delay": delay,
        "friction_base": drive.coulomb,
        "friction_viscous": drive.viscous,
        **{_FRICTION[name]: value for name, value in drive.friction.items()},
        "vin": of["supply"],
        "kp": drive.setting,
        "error_gain": of["gain"] if drive.means == "position" else 0.0,
        "max_pwm": of["duty_limit"],
        "max_current": None if drive.current_limit is None else strength * drive.current_limit,
        "not_the_same_here": _lost(drive, delay, lag),
    }
    write_json(path, content)


def _lost(drive: JointDrive, delay: float, lag: float) -> Sequence[str]:
    """What the calibrated drive does and BAM's does not, a clause each, with the size of it."""
    of = drive.numbers
    per_volt = of["strength"] * of["kt"] / of["resistance"]
    most = min(of["duty_limit"] * of["supply"] / of["resistance"], drive.current_limit or math.inf)
    stall, saturated = of["strength"] * of["kt"] * most, 1.0 / (1.0 + of["saturation"] * most)
    no_load = of["duty_limit"] * of["supply"] / of["kt"]
    clauses = {
        f"the command is a {drive.means} and BAM's is a position, so error_gain is 0": drive.means != "position",
        f"the firmware brakes by {of['damping_gain'] * of['supply'] * per_volt:.3g} N·m·s/rad, and BAM's loop does "
        "not": of["damping_gain"],
        f"saturation is left out, which at standstill and the largest current leaves {saturated * stall:.3g} of "
        f"{stall:.3g} N·m": of["saturation"],
        f"vin is the supply of the spec, and the log's {drive.supply_from} varies; 1 V is {per_volt:.3g} N·m at "
        "standstill": drive.supply_from,
        f"drag is left out, {drive.drag * no_load**2:.3g} N·m at the no-load speed of {no_load:.3g} rad/s": drive.drag,
        f"versions of BAM without command_delay leave {1e3 * delay:.3g} ms of delay out": delay,
        f"a lag of {1e3 * lag:.3g} ms with which the command is followed is left out": lag,
        "backlash and elasticity of the gear are left out": drive.gives,
        "friction by load counts contacts as load, and leaves springs out": any(
            value for name, value in drive.friction.items() if "load" in name or "quadratic" in name
        ),
    }
    return [clause for clause, lost in clauses.items() if lost]
