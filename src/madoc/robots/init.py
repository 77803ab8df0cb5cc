"""The first spec of a robot, written from its model: it loads as it is, and comments explain every part."""

import os
import re
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path

import mujoco
import numpy as np

from madoc.errors import MadocError
from madoc.parameters import FIELDS, Parameter
from madoc.robots.document import yaml_text
from madoc.robots.expressions import Read
from madoc.robots.model import compiled, is_single, is_slide, read_model
from madoc.robots.model_files import ModelFiles
from madoc.robots.space import element_unit
from madoc.runs.files import replacing
from madoc.simulation.write import OF_A_JOINT, element_names, heavy_bodies, nominal_values
from madoc.tasks import TASKS

Fields = dict[str, str | float]
_USUAL_STEP = 0.02
"""Proposed time between two actions in s, rounded to a multiple of the model's timestep."""
_ACTIVE = 16
"""Largest number of parameters proposed; further ones are written as comments."""
_PARTS = {
    mujoco.mjtJoint.mjJNT_FREE: (("x", "y", "z", "qw", "qx", "qy", "qz"), ("vx", "vy", "vz", "wx", "wy", "wz")),
    mujoco.mjtJoint.mjJNT_BALL: (("qw", "qx", "qy", "qz"), ("wx", "wy", "wz")),
}
"""Names of the values of a joint's position and velocity, where it has several."""


_REMARKS = {"actuator_gain": "", "geom_friction": "sliding, in contacts; "}
"""What stands in a comment instead of the unit of a field."""


def write_spec(model: Path, out: Path, *, allow_outside: bool = False) -> None:
    """Write a first spec for a model to a new file; `allow_outside` reads files outside the model's folder too.

    Raises:
        MadocError: The file exists already, its folder does not, or the model cannot be used.
    """
    from madoc.robots import load

    if out.exists():
        raise MadocError(f"{out} exists already; choose another --out, or delete it")
    if not out.parent.is_dir():
        raise MadocError(f"there is no folder {out.parent} to write {out.name} into; make it first")
    text = spec_text(model, out, allow_outside=allow_outside)
    with replacing(out) as stream:
        stream.write(text.encode())
    try:
        load(out, allow_outside=allow_outside)
    except MadocError as error:
        out.unlink()
        raise MadocError(f"no spec can be made of {model}: {error}") from error


def spec_text(model: Path, out: Path, *, allow_outside: bool = False) -> str:
    """The text of a first spec for a model, with comments, for a file at `out`; a model without names is refused."""
    files = ModelFiles.read(model, allow_outside=allow_outside)
    made = compiled(partial(read_model, files), files.main)
    joints = element_names(made, "joint")
    if not joints:
        raise MadocError(f"no joint of {model} has a name, and a spec reads joints by name; name them in the model")
    signals = list(_signals(made, joints))
    actions = list(_actions(made, joints, {name for name, *_ in signals}))
    if not actions:
        raise MadocError(f"no actuator of {model} has a name, and a spec drives them by name; name them in the model")
    timestep = float(made.opt.timestep)
    step = timestep * max(1, round(_USUAL_STEP / timestep))
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", model.stem).strip("_-") or "robot"
    relative = Path(os.path.relpath(model.resolve(), out.parent.resolve())).as_posix()
    lines = [
        f"# A robot for Madoc, written from {model.name} by `madoc init`. What it means: madoc spec {out.name}",
        "madoc: 1",
        f"name: {_quoted('my_' + name if name in TASKS else name)}",
        f"model: {_quoted(relative)}  # MJCF or URDF, relative to this file",
        f"control_step: {step:.12g}  # s between two actions; a multiple of the model's timestep, {timestep:.12g} s",
        "",
        "# The observation: one number a line. Each reads position(JOINT), velocity(JOINT) or sensor(NAME), one of",
        "# several values as sensor(NAME)[2], or an expression of them with + - * / **, sin cos tan sqrt abs and pi:",
        '#   {name: height, reads: "sensor(tip)[2] * 1000", unit: mm}',
        "# Take out what your log does not have. With every position and velocity, states can be rebuilt from the log.",
        "signals:",
        *(f"  - {_mapping(name=name, reads=reads, unit=unit)}" for name, reads, unit in signals),
        *_sensors(made),
        *_unnamed(made),
        "",
        "# The action: what the log's action columns mean, and their limits. An `actuator` is one of the model's and",
        "# gets the value as its control. A `joint` gets a new one: means: torque (of a slide, force); means: position",
        "# with kp: and kd:; means: velocity with kd:. Units deg, deg/s, mm, mm/s, cm and mN·m are converted.",
        "actions:",
        *(f"  - {_mapping(**fields)}{comment}" for fields, comment in actions),
        "",
        "# What is calibrated, each within its range: wide enough to hold the truth, and only what matters.",
        "# One value for several: {field: dof_damping, elements: [left, right], name: damping, low: 0, high: 1}",
        "parameters:",
        *_parameters(made, joints),
        f"  # - {{field: action_delay, low: 0, high: {2 * step:.6g}}}  # s from an action to its effect",
        f"  # - {_mapping(field='signal_bias', element=signals[0][0], low=-0.1, high=0.1)}  # what it reads too much",
        "",
        "# How a log is laid out, where it is not as above.",
        "# log:",
        "#   time: time            # column of timestamps, s",
        f"#   columns: {{{_quoted(signals[0][0])}: my_column}}  # our name -> the log's",
        "#   resample: null        # hold or linear: bring another rate to control_step",
        "#   tolerance: 0.1        # how far a time step may be from control_step, as a share",
        "",
        "# What a policy should do, for `madoc run` and `madoc learn`. reward: an expression of signals after the step",
        "# and actions. end: a condition. goals: what is drawn for each episode and observed. reset: where it begins.",
        "# reward: null",
        "# end: null",
        '# goals: []  # as [{name: target, drawn: "uniform(-1, 1)"}]',
        '# reset: {}  # as {position(JOINT): "uniform(-0.1, 0.1)"}, also normal(MEAN, DEVIATION)',
    ]
    return "\n".join(lines) + "\n"


def _signals(model: mujoco.MjModel, joints: list[str]) -> Iterator[tuple[str, str, str]]:
    """Name, expression and unit of every position, then of every velocity."""
    for kind in ("position", "velocity"):
        for joint in joints:
            index = model.joint(joint).id
            speed, reads = kind == "velocity", str(Read(kind, joint))
            if is_single(model, index):
                unit = "m" if is_slide(model, index) else "rad"
                yield (f"{joint}_speed", reads, f"{unit}/s") if speed else (joint, reads, unit)
                continue
            for at, part in enumerate(_PARTS[int(model.jnt_type[index])][speed]):
                yield f"{joint}_{part}", f"{reads}[{at}]", {"q": "1", "v": "m/s", "w": "rad/s"}.get(part[0], "m")


def _sensors(model: mujoco.MjModel) -> Iterator[str]:
    """The model's sensors, as comments: a log seldom has them all."""
    for sensor in element_names(model, "sensor"):
        size = int(model.sensor_dim[model.sensor(sensor).id])
        for index in [None] if size == 1 else range(size):
            label = sensor if index is None else f"{sensor}_{index}"
            yield f"  # - {_mapping(name=label, reads=str(Read('sensor', sensor, index)))}"


def _unnamed(model: mujoco.MjModel) -> Iterator[str]:
    """Comments on joints, actuators and sensors that cannot be used because they have no name."""
    for what, count in (("joint", model.njnt), ("actuator", model.nu), ("sensor", model.nsensor)):
        missing = count - len(element_names(model, what))
        if missing:
            yield f"  # {missing} {what}{'s' * (missing > 1)} of the model cannot be used here: give each a name there."


def _actions(model: mujoco.MjModel, joints: list[str], taken: set[str]) -> Iterator[tuple[Fields, str]]:
    """The model's actuators; a torque on every joint where it has none."""
    for actuator in element_names(model, "actuator"):
        index = model.actuator(actuator).id
        name = f"{actuator}_command" if actuator in taken else actuator
        limited = bool(model.actuator_ctrllimited[index])
        low, high = model.actuator_ctrlrange[index] if limited else (-1.0, 1.0)
        comment = "" if limited else "  # the model has no ctrlrange: write its limits"
        yield {"name": name, "actuator": actuator, "low": float(low), "high": float(high)}, comment
    for joint in joints if not model.nu else ():
        index = model.joint(joint).id
        if not is_single(model, index):
            continue
        limited = bool(model.jnt_actfrclimited[index])
        low, high = model.jnt_actfrcrange[index] if limited else (-1.0, 1.0)
        means, unit = ("force", "N") if is_slide(model, index) else ("torque", "N·m")
        comment = "" if limited else f"  # the model has no limit: write the motor's largest {means}"
        fields = {"name": f"{joint}_{means}", "joint": joint, "means": means}
        yield {**fields, "low": float(low), "high": float(high), "unit": unit}, comment


def _parameters(model: mujoco.MjModel, joints: list[str]) -> Iterator[str]:
    """Parameters of bodies, joints, actuators and contacts; those less likely to matter are written as comments."""
    sprung = [joint for joint in joints if is_single(model, model.joint(joint).id)]
    geoms = [model.geom(name) for name in element_names(model, "geom")]
    touching = [geom.name for geom in geoms if geom.contype[0] or geom.conaffinity[0]]
    rows = [
        *_scaled(model, "body_mass", heavy_bodies(model), wanted=True),
        *_scaled(model, "jnt_stiffness", sprung, wanted=True),
        *_dissipation(model, joints),
        *_scaled(model, "actuator_gain", element_names(model, "actuator")),
        *_scaled(model, "geom_friction", touching),
    ]
    active = 0
    for fields, comment, wanted in rows:
        active += wanted
        yield f"  {'' if wanted and active <= _ACTIVE else '# '}- {_mapping(**fields)}  # {comment}"


def _scaled(
    model: mujoco.MjModel, field: str, names: Iterable[str], *, wanted: bool = False
) -> Iterator[tuple[Fields, str, bool]]:
    """A field of elements where the model's value is above 0, from half of it to twice."""
    for name in names:
        (value,) = nominal_values(model, Parameter(field, name, 0.0, 1.0))
        if value > 0:
            unit = _REMARKS[field] if field in _REMARKS else f"{_unit(model, field, name)}; "
            fields: Fields = {"field": field, "element": name, "low": _round(value / 2), "high": _round(value * 2)}
            yield fields, f"{unit}the model has {value:.4g}", wanted


def _dissipation(model: mujoco.MjModel, joints: list[str]) -> Iterator[tuple[Fields, str, bool]]:
    """Damping and dry friction of joints; those neither driven nor damped are comments, as they may be a root's."""
    on_joints = np.isin(model.actuator_trntype, OF_A_JOINT)
    # Through tendons an actuator may drive any joint.
    driven = set(model.actuator_trnid[:, 0]) if model.nu and on_joints.all() else set(range(model.njnt))
    for field, wanted in (("dof_damping", True), ("dof_frictionloss", False)):
        for joint in joints:
            index = model.joint(joint).id
            if int(model.jnt_type[index]) == mujoco.mjtJoint.mjJNT_FREE:
                continue
            (value,) = nominal_values(model, Parameter(field, joint, 0.0, 1.0))
            # Where the model has none: the damping that would stop the joint and all bodies on it in 0.1 s.
            high = 2 * value if value > 0 else 10 * float(model.dof_M0[model.jnt_dofadr[index]])
            fields: Fields = {"field": field, "element": joint, "low": 0.0, "high": _round(high)}
            comment = f"{_unit(model, field, joint)}; the model has {value:.4g}"
            yield fields, comment, wanted and (value > 0 or index in driven)


def _unit(model: mujoco.MjModel, field: str, element: str) -> str:
    """The unit of a field of a body or a joint."""
    return element_unit(model, field, element) or FIELDS[field].unit


def _round(value: float) -> float:
    """The value with two digits, which are enough for a range."""
    return float(np.format_float_positional(value, precision=2, fractional=False)) if value > 0 else value


def _mapping(**fields: str | float) -> str:
    """A YAML mapping on one line."""
    return _quoted({key: value if isinstance(value, str) else _number(value) for key, value in fields.items()})


def _number(value: float) -> float:
    """A number with twelve digits, and without a point where it is whole."""
    short = float(f"{value:.12g}")
    return int(short) if short.is_integer() else short


def _quoted(value: str | Fields) -> str:
    """Text or a mapping as YAML on one line, with quotes where they are needed."""
    return yaml_text(value, width=10_000, flow=True).removesuffix("...\n").strip()
