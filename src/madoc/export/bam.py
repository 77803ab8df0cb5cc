"""Calibrated drives as parameter files of BAM (Rhoban/bam), which its MuJoCo and mjlab actuators and Isaac Lab read.

BAM's equations are ours: duty = clip(error_gain · kp · (target - q), ±max_pwm), current = (duty · vin - kt · ω) / R,
torque = kt · current, and friction by model M6, which has M1 to M5 in it (`callbacks.friction_limit`). A factor on the
torque is a smaller resistance and a larger current. Where a joint is driven faster than its supply could, BAM lets the
current past its limit and Madoc does not.
"""

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path

from madoc.runs.files import replacing
from madoc.simulation.configuration import JointDrive

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


def bam_files(folder: Path, drives: Sequence[JointDrive]) -> list[Path]:
    """Where the parameters of each drive are left."""
    names = [re.sub(r"[^A-Za-z0-9_.-]", "_", drive.name) for drive in drives]
    if len({*names}) < len(names):
        names = [f"{name}-{at}" for at, name in enumerate(names)]
    return [folder / f"bam-{name}.json" for name in names]


def save_bam(path: Path, drive: JointDrive, delay: float, lag: float = 0.0) -> None:
    """Write the parameters of one drive, its joint's friction and armature, and what BAM cannot say of them.

    Friction is BAM's `m1` where MuJoCo's own elements say it, else `m6`: Isaac Lab reads neither `m3` nor `m4`.

    Args:
        path: The file.
        drive: The drive at the estimate.
        delay: From a command to its effect, s.
        lag: Time constant with which the command is followed, s.
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
    with replacing(path) as stream:
        stream.write((json.dumps(content, indent=2, ensure_ascii=False) + "\n").encode())


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
