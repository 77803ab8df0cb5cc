"""A calibrated robot as source for the libraries that policies are trained in: mjlab and Isaac Lab.

Each file is what a person would have written there: the actuators as the library's own configuration, and one function
that draws whole models out of the joint distribution. What the library cannot say is named in its first lines.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import jinja2

from madoc.export.parameter_files import Exported
from madoc.runs.files import replacing
from madoc.simulation.configuration import JointActuator

MJLAB = "1.6"
"""Version of mjlab whose names `mjlab_robot.py` uses; it was run with it."""
ISAAC_LAB = "3.0"
"""Version of Isaac Lab whose names `isaac_lab_robot.py` uses; they were compared with its published source."""


@dataclass(frozen=True)
class Robot:
    """What a configuration says of a calibrated robot, besides its model.

    Attributes:
        name: Its name.
        actuators: Those that actions drive.
        start: Position of each hinge and slide at the start, rad or m.
        physics: Options of the model by their names in mjlab's `MujocoCfg`, as source.
        decimation: Physics steps between two commands.
        timestep: Of the physics, s.
        delay: From a command to its effect, s.
        fields: Arrays of the model in which draws differ.
        lost: What MuJoCo's options say and mjlab's do not, a clause each.
        rounded: A clause with what it costs over held-out runs that the delay is a whole number of physics steps.
        base: Position of a floating base at the start, m, and attitude, a unit quaternion; None of a fixed base.
    """

    name: str
    actuators: Sequence[JointActuator]
    start: Mapping[str, float]
    physics: Mapping[str, str]
    decimation: int
    timestep: float
    delay: float
    fields: Sequence[str]
    lost: Sequence[str]
    rounded: str = ""
    base: tuple[tuple[float, ...], tuple[float, ...]] | None = None


def save_mjlab(path: Path, robot: Robot, exported: Sequence[Exported]) -> None:
    """Write `mjlab_robot.py`: an `EntityCfg`, a `MujocoCfg`, and an event that draws models from `draws.npz`.

    Position servos become `BuiltinPositionActuatorCfg`, those of equal numbers together; other actuators stay as
    model.xml has them.
    """
    lag, unsaid = _lag(robot)
    groups: dict[tuple[tuple[str, str], ...], list[str]] = {}
    commanded: set[str] = set()
    untold = []
    for each in robot.actuators:
        target = each.joint or each.tendon or each.site
        if not target or target in commanded:
            untold.append(each.name)
            continue
        commanded.add(target)
        groups.setdefault(tuple(_of_mjlab(each).items()), []).append(target)
    delay = {"delay_min_lag": str(lag), "delay_max_lag": str(lag)} if lag else {}
    actuators = [
        (kind, {"target_names_expr": _tuple(map(re.escape, targets)), **dict(arguments), **delay})
        for ((_, kind), *arguments), targets in groups.items()
    ]
    placed = [field for field in robot.fields if field.partition("_")[0] in _PLACED]
    left = [field for field in robot.fields if field not in placed]
    unsaid += [f"draws do not reach {field}, which stays that of model.xml" for field in left]
    unsaid += [
        f"no actuator here commands {name}, as it acts on nothing that has a name, or on what another one commands"
        for name in untold
    ]
    lost = [*robot.lost, *unsaid, *_around(exported, "dr.encoder_bias adds it to what is observed")]
    if any(each.servo for each in robot.actuators):
        lost.append("commands beyond their range in the spec are not cut off by BuiltinPositionActuatorCfg")
    _write(
        path,
        "mjlab_robot.py.j2",
        robot=robot.name,
        version=MJLAB,
        lost=lost,
        imported=sorted({kind for kind, _ in actuators}),
        transmissions=any("transmission_type" in arguments for _, arguments in actuators),
        actuators=actuators,
        servos=_tuple(each.name for each in robot.actuators if each.servo and each.name not in untold),
        start=_table(robot.start),
        base=robot.base,
        physics=robot.physics,
        decimation=robot.decimation,
        fields=_tuple(placed),
    )


def save_isaac_lab(path: Path, robot: Robot, exported: Sequence[Exported]) -> None:
    """Write `isaac_lab_robot.py`: actuator configurations, and an event term that draws rows of `draws.npz`.

    PhysX is another simulator: the numbers are those of MuJoCo's joints and drives, and what they come to there has to
    be looked at.
    """
    lag, unsaid = _lag(robot)
    groups: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for each in robot.actuators:
        if each.joint:
            groups.setdefault(tuple(_of_isaac(each, explicit=lag > 0).items()), []).append(each.joint)
    delay = {"min_delay": str(lag), "max_delay": str(lag)} if lag else {}
    actuators = [
        {"joint_names_expr": repr([re.escape(joint) for joint in joints]), **dict(arguments), **delay}
        for arguments, joints in groups.items()
    ]
    lost = [*unsaid, *(f"{each.name} drives no single joint" for each in robot.actuators if not each.joint)]
    lost += [
        f"{row.parameter.name} = {row.row.estimate:.6g} {row.row.unit} has to go into the robot's USD "
        f"file{row.left_out}"
        for row in exported
        if row.parameter.kind.in_model and not _drawn(row, robot)
    ]
    drawn = [(*quantity, column) for column, row in enumerate(exported) if (quantity := _drawn(row, robot))]
    _write(
        path,
        "isaac_lab_robot.py.j2",
        robot=robot.name,
        version=ISAAC_LAB,
        lost=[*lost, *_around(exported, "subtract it from what is logged")],
        kind="DelayedPDActuatorCfg" if lag else "ImplicitActuatorCfg",
        actuators=actuators,
        drawn=drawn,
        timestep=repr(robot.timestep),
        decimation=robot.decimation,
    )


_PLACED = ("actuator", "body", "dof", "geom", "jnt", "qpos", "qpos0")
"""First words of the arrays of a model whose rows `mjlab_robot.py` finds again in a scene."""
_JOINT_WRITERS = {
    "dof_armature": "armature",
    "dof_frictionloss": "friction",
    "dof_damping": "viscous_friction",
    "actuator_gain": "stiffness",
    "actuator_kv": "damping",
}
"""Fields that Isaac Lab lets an event write joint by joint, and what it calls them."""


def _of_mjlab(actuator: JointActuator) -> dict[str, str]:
    """The kind and the arguments of an actuator's configuration, as source."""
    if not actuator.servo:
        through = "tendon" if actuator.tendon else "site" if actuator.site else ""
        transmission = {"transmission_type": f"TransmissionType.{through.upper()}"} if through else {}
        return {"kind": "XmlActuatorCfg", "command_field": repr(actuator.means), **transmission}
    limit = {} if actuator.effort_limit is None else {"effort_limit": repr(actuator.effort_limit)}
    return {
        "kind": "BuiltinPositionActuatorCfg",
        "stiffness": repr(actuator.stiffness),
        "damping": repr(actuator.damping),
        **limit,
        "armature": repr(actuator.armature),
        "frictionloss": repr(actuator.friction),
        "viscous_damping": repr(actuator.viscous),
    }


def _of_isaac(actuator: JointActuator, *, explicit: bool) -> dict[str, str]:
    """The arguments of an actuator's configuration; an explicit one cuts its force off itself, PhysX that of others."""
    name = "effort_limit" if explicit else "effort_limit_sim"
    limit = {} if actuator.effort_limit is None else {name: repr(actuator.effort_limit)}
    return {
        "stiffness": repr(actuator.stiffness),
        "damping": repr(actuator.damping),
        **limit,
        "armature": repr(actuator.armature),
        "friction": repr(actuator.friction),
        "dynamic_friction": repr(actuator.friction),
        "viscous_friction": repr(actuator.viscous),
    }


def _drawn(row: Exported, robot: Robot) -> tuple[str, list[str]] | None:
    """The quantity of joints that a parameter is in Isaac Lab, and the joints; None where it is none."""
    quantity = _JOINT_WRITERS.get(row.parameter.field)
    if quantity not in ("stiffness", "damping"):
        return (quantity, list(row.parameter.elements)) if quantity else None
    servos = {each.name: each.joint for each in robot.actuators if each.servo}
    joints = [servos[name] for name in row.parameter.elements if name in servos]
    return (quantity, joints) if len(joints) == len(row.parameter.elements) else None


def _lag(robot: Robot) -> tuple[int, list[str]]:
    """The delay in whole physics steps, and a clause with what rounding it changes."""
    lag = round(robot.delay / robot.timestep)
    less = 1e3 * (robot.delay - lag * robot.timestep)
    if abs(less) < 1e-6:
        return lag, []
    return lag, [
        f"a delay of {lag} physics steps is {abs(less):.3g} ms {'less' if less > 0 else 'more'} than estimated"
        f"{robot.rounded}"
    ]


def _around(exported: Sequence[Exported], how: str) -> list[str]:
    """What is not of the model: biases, and how to say them; lags, and delays of single actions."""
    told = {
        "signal_bias": how,
        "action_lag": "no actuator here follows its command with a lag",
        "action_delay": "it delays its own actions alone, and a delay here is one for all actuators",
    }
    return [
        f"{row.parameter.name} = {row.row.estimate:.6g} {row.row.unit} is not of the model: "
        f"{told[row.parameter.field]}{row.left_out}"
        for row in exported
        if row.parameter.field in told and (row.parameter.field != "action_delay" or row.parameter.elements)
    ]


def _tuple(items: Iterable[str]) -> str:
    return repr(tuple(items))


def _table(values: Mapping[str, float]) -> str:
    return "{" + ", ".join(f"{re.escape(name)!r}: {value!r}" for name, value in values.items()) + "}"


@cache
def _templates() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.PackageLoader("madoc.export"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # it writes Python, and every value in it is a number or a repr
    )


def _write(path: Path, template: str, *, lost: Iterable[str], **values: object) -> None:
    """Render a template; clauses stand in its docstring, where a name of the user's may neither end nor escape it."""
    clauses = [clause.replace("\\", "/").replace('"', "'") for clause in lost]
    with replacing(path) as stream:
        stream.write(_templates().get_template(template).render(values, lost=clauses).encode())
