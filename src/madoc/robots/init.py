"""The first spec of a robot, written from its model: it loads as it is, and comments explain every part."""

import os
import re
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from functools import partial
from itertools import takewhile
from pathlib import Path

import mujoco
import numpy as np

from madoc.errors import MadocError, listed, nearest_hint
from madoc.parameters import FIELDS
from madoc.robots.document import yaml_text
from madoc.robots.expressions import Read
from madoc.robots.model import AddedActuator, compiled, is_single, is_slide, make_model, read_model
from madoc.robots.model_files import ModelFiles
from madoc.robots.proposals import MOST, RECIPES, Proposal, Recipe, is_servo, proposals, rounded, strengths
from madoc.runs.files import replacing
from madoc.simulation.write import element_names, free_joints
from madoc.tasks import TASKS

Fields = dict[str, str | float | list[str]]
_USUAL_STEP = 0.02
"""Proposed time between two actions in s, rounded to a multiple of the model's timestep."""
_STIFF = 10.0
"""Stiffness of a proposed servo, as a share of its largest torque, 1/rad: it reaches that at a tenth of a radian."""
_PARTS = {
    mujoco.mjtJoint.mjJNT_FREE: (("x", "y", "z", "qw", "qx", "qy", "qz"), ("vx", "vy", "vz", "wx", "wy", "wz")),
    mujoco.mjtJoint.mjJNT_BALL: (("qw", "qx", "qy", "qz"), ("wx", "wy", "wz")),
}
"""Names of the values of a joint's position and velocity, where it has several."""


def write_spec(model: Path, out: Path, *, allow_outside: bool = False, recipe: str = "") -> None:
    """Write a first spec for a model to a new file; `allow_outside` reads files outside the model's folder too.

    Raises:
        MadocError: The file exists already, its folder does not, there is no such recipe, or the model cannot be used.
    """
    from madoc.robots import load

    if out.exists():
        raise MadocError(f"{out} exists already; choose another --out, or delete it")
    if not out.parent.is_dir():
        raise MadocError(f"there is no folder {out.parent} to write {out.name} into; make it first")
    if recipe and recipe not in RECIPES:
        raise MadocError(f"there is no recipe {recipe!r}; {nearest_hint(recipe, RECIPES)}")
    text = spec_text(model, out, allow_outside=allow_outside, recipe=recipe)
    with replacing(out) as stream:
        stream.write(text.encode())
    try:
        load(out, allow_outside=allow_outside)
    except MadocError as error:
        out.unlink()
        raise MadocError(f"no spec can be made of {model}: {error}") from error


def spec_text(model: Path, out: Path, *, allow_outside: bool = False, recipe: str = "") -> str:
    """The text of a first spec for a model, with comments, for a file at `out`; a model without names is refused."""
    files = ModelFiles.read(model, allow_outside=allow_outside)
    base = read_model(files)
    made = compiled(partial(make_model, base), files.main)
    if not made.njnt:
        raise MadocError(f"nothing in {model} moves: it has no joint; is it part of a model, as a scene or a table?")
    joints = element_names(made, "joint")
    if not joints:
        raise MadocError(f"no joint of {model} has a name, and a spec reads joints by name; name them in the model")
    chosen = RECIPES.get(recipe)
    signals = list(_signals(made, joints))
    actions = list(_actions(made, joints, {name for name, *_ in signals}, chosen))
    if not actions:
        what = "no actuator has a name" if made.nu else "it has no actuator, and no joint that turns or slides"
        raise MadocError(f"no action of {model} can be written: {what}; add one to the model, by name")
    added = tuple(one for one in (_added(fields) for fields, _ in actions) if one is not None)
    driven, guessed = compiled(partial(make_model, base, added), files.main), frozenset(one.name for one in added)
    timestep = float(made.opt.timestep)
    step = timestep * max(1, round(_USUAL_STEP / timestep))
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", model.stem).strip("_-") or "robot"
    relative = Path(os.path.relpath(model.resolve(), out.parent.resolve())).as_posix()
    lines = [
        f"# A robot for Madoc, written from {model.name} by `madoc init`. What it means: madoc spec {out.name}",
        "madoc: 1",
        f"name: {_quoted('my_' + name if name in TASKS else name)}",
        f"model: {_quoted(relative)}  # MJCF or URDF, relative to this file",
        *_remarks(made),
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
        "# with kp: and kd:; means: velocity with kd:. Units deg, deg/s, mm, mm/s, cm and mN·m are converted. A",
        "# machine without a drive, which only swings or falls, has actions: []",
        "actions:",
        *(f"  - {_mapping(**fields)}{comment}" for fields, comment in actions),
        "",
        "# What is calibrated, each within its range: wide enough to hold the truth, and only what matters.",
        '# One value for several: {field: dof_damping, elements: "*_knee", name: knees, low: 0, high: 1}, or one for',
        '# each of several: {field: dof_damping, each: "*_knee", low: 0, high: 1}.',
        *([] if chosen is None else [f"# Ranges of {recipe}: of {chosen.about}."]),
        "parameters:",
        *_parameters(driven, proposals(driven, chosen, recipe, guessed=guessed, step=step)),
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


def _actions(
    model: mujoco.MjModel, joints: list[str], taken: set[str], recipe: Recipe | None
) -> Iterator[tuple[Fields, str]]:
    """The model's actuators; where it has none, a position, a torque or a force of every hinge and slide."""
    for actuator in element_names(model, "actuator"):
        index = model.actuator(actuator).id
        name = f"{actuator}_command" if actuator in taken else actuator
        ends, comment = _command_ends(model, actuator)
        yield {"name": name, "actuator": actuator, "low": ends[0], "high": ends[1]}, comment
    strong = strengths(model)
    for joint in joints if not model.nu else ():
        index = model.joint(joint).id
        if not is_single(model, index):
            continue
        slide, (torque, known) = is_slide(model, index), strong[joint]
        torque = recipe.limit if recipe and recipe.limit and not slide and not known else rounded(torque)
        positioned = bool(model.jnt_limited[index]) and (recipe is None or recipe.means == "position")
        if positioned:
            low, high = (float(f"{end:.6g}") for end in model.jnt_range[index])
            kp = rounded(_STIFF * torque)
            kd = rounded(float(np.sqrt(kp * model.dof_M0[model.jnt_dofadr[index]])))
            fields: Fields = {"name": f"{joint}_target", "joint": joint, "means": "position", "kp": kp, "kd": kd}
            fields |= {"limit": torque} if known or (recipe and recipe.limit) else {}
            fields |= {"low": low, "high": high, "unit": "m" if slide else "rad"}
            yield fields, "  # not in the model, so kp and kd are guesses; or means: torque"
            continue
        means, unit = ("force", "N") if slide else ("torque", "N·m")
        comment = "" if known else f"  # the model has no limit: write the motor's largest {means}"
        fields = {"name": f"{joint}_{means}", "joint": joint, "means": means}
        yield fields | {"low": -torque, "high": torque, "unit": unit}, comment


def _command_ends(model: mujoco.MjModel, actuator: str) -> tuple[tuple[float, float], str]:
    """The limits of an actuator's command, and what to say of them: its own, or those of what it moves."""
    index = model.actuator(actuator).id
    if model.actuator_ctrllimited[index]:
        low, high = model.actuator_ctrlrange[index]
        return (float(low), float(high)), ""
    joint = int(model.actuator_trnid[index, 0])
    if is_servo(model, actuator) and model.jnt_limited[joint]:
        low, high = model.jnt_range[joint]
        return (float(f"{low:.6g}"), float(f"{high:.6g}")), "  # the model has no ctrlrange: the range of the joint"
    most = np.pi if is_servo(model, actuator) else 1.0
    if model.actuator_forcelimited[index] and not is_servo(model, actuator) and model.actuator_gainprm[index, 0]:
        most = float(abs(model.actuator_forcerange[index] / model.actuator_gainprm[index, 0]).max())
    most = float(f"{most:.6g}")
    return (-most, most), "  # the model has no ctrlrange: write its limits"


def _added(fields: Fields) -> AddedActuator | None:
    """The actuator that an action of this spec adds to the model, so that its gains can be proposed too."""
    if "joint" not in fields:
        return None
    kp, kd, low, high = (float(str(fields.get(key, 0.0))) for key in ("kp", "kd", "low", "high"))
    limit = float(str(fields["limit"])) if "limit" in fields else None if kp else max(abs(low), abs(high))
    return AddedActuator(str(fields["name"]), str(fields["joint"]), low, high, kp or 1.0, kp, kd, limit)


def _remarks(model: mujoco.MjModel) -> Iterator[str]:
    """What a user should know of the model before a log of it is read, as comments."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for joint in free_joints(model):
        yield f"# The body of {joint.name or 'a joint without a name'} moves freely: a log has to tell where it is."
    grounds = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
    if free_joints(model) and model.opt.gravity.any() and not np.isin(model.geom_type, grounds).any():
        yield "# The model has no floor: what moves freely falls for ever; add one, or hang the robot in the model too."
    pairs = sorted({tuple(sorted(_geom_name(model, geom) for geom in pair)) for pair in data.contact.geom.tolist()})
    if pairs:
        touching = listed((" and ".join(pair) for pair in pairs), most=4)
        yield f"# In the model's first pose these touch: {touching}."
    held = [model.equality(index).name or f"number {index}" for index in range(model.neq) if model.eq_active0[index]]
    if held:
        yield f"# Equalities hold: {listed(held, most=8)}. What they tie together moves as one."
    mocap = [model.body(index).name for index in np.flatnonzero(model.body_mocapid >= 0).tolist()]
    if mocap:
        yield f"# Mocap bodies stay where the model has them: {listed(mocap, most=8)}."


def _geom_name(model: mujoco.MjModel, geom: int) -> str:
    """The name of a geom, or of its body where it has none."""
    return model.geom(geom).name or model.body(int(model.geom_bodyid[geom])).name or f"geom {geom}"


def _parameters(model: mujoco.MjModel, lines: list[Proposal]) -> Iterator[str]:
    """Lines of parameters; those less likely to matter are comments."""
    for line in lines:
        fields: Fields = {"field": line.field}
        if len(line.elements) == 1:
            fields["element"] = line.elements[0]
        elif line.elements:
            known = element_names(model, str(FIELDS[line.field].element))
            pattern = _pattern(line.elements, known)
            fields["elements"] = pattern or list(line.elements)
            if not pattern:
                fields["name"] = f"{line.field}.{line.elements[0]}+{len(line.elements) - 1}"
        fields |= {"low": line.low, "high": line.high}
        yield f"  {'' if line.wanted else '# '}- {_mapping(**fields)}  # {line.comment}"
    left = sum(not line.wanted for line in lines)
    if left:
        yield f"  # The {left} lines that are comments matter less, or are more than the {MOST} that init proposes."


def _pattern(wanted: tuple[str, ...], known: list[str]) -> str:
    """A pattern that all of these names and no others match, from what they begin and end with; empty without one."""
    begin = _beginning(wanted)
    end = _beginning([name[len(begin) :][::-1] for name in wanted])[::-1]
    for pattern in (f"*{end}" * (not end[:1].isalnum()), f"{begin}*" * (not begin[-1:].isalnum()), f"{begin}*{end}"):
        if begin + end and tuple(name for name in known if fnmatchcase(name, pattern)) == wanted:
            return pattern
    return ""


def _beginning(names: Sequence[str]) -> str:
    """What all names begin with."""
    alike = takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    return "".join(letters[0] for letters in alike)


def _mapping(**fields: str | float | list[str]) -> str:
    """A YAML mapping on one line."""
    return _quoted({key: _number(value) if isinstance(value, int | float) else value for key, value in fields.items()})


def _number(value: float) -> float:
    """A number with twelve digits, and without a point where it is whole."""
    short = float(f"{value:.12g}")
    return int(short) if short.is_integer() else short


def _quoted(value: str | Fields) -> str:
    """Text or a mapping as YAML on one line, with quotes where they are needed."""
    return yaml_text(value, width=10_000, flow=True).removesuffix("...\n").strip()
