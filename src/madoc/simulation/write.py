"""Parameters into a MuJoCo model: elements found by name, values written, derived constants recomputed."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any

import mujoco
import numpy as np

from madoc.errors import MadocError, nearest_hint
from madoc.parameters import FIELDS, INERTIA, PAYLOAD, Parameter
from madoc.simulation.arrays import check_field, check_written, numbers_at, rows_of, write_number
from madoc.simulation.inertials import (
    write_centre_of_mass,
    write_deviations,
    write_inertia,
    write_mass,
    write_mass_and_inertia,
)
from madoc.simulation.joints import (
    LEAST_FRICTION,
    backlash,
    deflections,
    drive_number,
    friction_numbers,
    gear_numbers,
    has_numbers,
    has_speed_or_load_friction,
    write_backlash,
    write_elements,
)
from madoc.tasks.base import Task

SOLREF_FLOOR = 1e-9
"""Time constant of a contact, s, and damping ratio to which smaller ones are raised, as 0 means another format."""

_KINDS = {
    "body": (mujoco.mjtObj.mjOBJ_BODY, "nbody"),
    "joint": (mujoco.mjtObj.mjOBJ_JOINT, "njnt"),
    "geom": (mujoco.mjtObj.mjOBJ_GEOM, "ngeom"),
    "actuator": (mujoco.mjtObj.mjOBJ_ACTUATOR, "nu"),
    "sensor": (mujoco.mjtObj.mjOBJ_SENSOR, "nsensor"),
    "site": (mujoco.mjtObj.mjOBJ_SITE, "nsite"),
    "pair": (mujoco.mjtObj.mjOBJ_PAIR, "npair"),
    "tendon": (mujoco.mjtObj.mjOBJ_TENDON, "ntendon"),
    "equality": (mujoco.mjtObj.mjOBJ_EQUALITY, "neq"),
}
"""By kind of element, MuJoCo's object type and the attribute of a model that counts them."""

ONE_DOF = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
"""Types of joints with one degree of freedom."""
OF_A_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
"""Transmissions of actuators that act on one joint; for a hinge or a slide the two are the same."""


Conditions = Mapping[str, float | None]
"""Values of conditions of a run, by name; None is one under which no parameter that names the condition holds."""


def conditions_of(parameters: Sequence[Parameter]) -> list[Conditions]:
    """Every combination of the conditions that parameters name, that of the first value of each first."""
    values: dict[str, list[float | None]] = {}
    for name, value in (parameter.when for parameter in parameters if parameter.when is not None):
        values[name] = list(dict.fromkeys([*values.get(name, []), value]))
    return [dict(zip(values, each, strict=True)) for each in product(*([*of_one, None] for of_one in values.values()))]


def write_parameters(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    parameters: Sequence[Parameter],
    values: np.ndarray,
    conditions: Conditions | None = None,
) -> None:
    """Write physical values (d,) into a model in place, then recompute the constants derived from them (`mj_setConst`).

    Of parameters that name a condition those that hold under it are written; by default its first value is taken. A
    parameter that names an element the model does not have, or that scales a mass of 0, is refused.
    """
    holding = conditions_of(parameters)[0] if conditions is None else conditions
    of_bodies: dict[int, dict[str, float]] = {}
    for parameter, value in zip(parameters, values, strict=True):
        holds = parameter.when is None or holding[parameter.when[0]] == parameter.when[1]
        if holds and parameter.kind.in_model:
            for element in find_elements(model, parameter):
                numbers, write = _place_of(parameter.field)
                if parameter.field in (*PAYLOAD, *INERTIA):
                    of_bodies.setdefault(element, {})[parameter.field] = float(value)
                elif write is None:
                    numbers(model, element)[:] = value
                else:
                    write(model, element, float(value))
    for body, deviations in of_bodies.items():
        write_deviations(model, body, deviations)
    write_elements(model)
    mujoco.mj_setConst(model, data)


def nominal_values(model: mujoco.MjModel, parameter: Parameter) -> tuple[float, ...]:
    """The values in a model that a parameter would replace, one for each element; 0 for a delay and for biases."""
    if not parameter.kind.in_model:
        return tuple(0.0 for _ in parameter.elements or (0,))
    numbers, _ = _place_of(parameter.field)
    return tuple(float(numbers(model, element).flat[0]) for element in find_elements(model, parameter))


def same_numbers(model: mujoco.MjModel, one: Parameter, other: Parameter) -> bool:
    """Whether two parameters, one of them of a number by its array's name, are written into the same place."""
    if {one.field, other.field} <= FIELDS.keys() or not (one.kind.in_model and other.kind.in_model):
        return False
    here, there = (
        [_place_of(each.field)[0](model, element) for element in find_elements(model, each)] for each in (one, other)
    )
    return any(np.shares_memory(ours, theirs) for ours in here for theirs in there)


def diagonal_bodies(model: mujoco.MjModel, parameter: Parameter) -> list[str]:
    """Elements of a parameter of a payload or an inertia, of whose mass matrix MuJoCo keeps the diagonal alone."""
    if parameter.field not in (*PAYLOAD, *INERTIA):
        return []
    bodies = zip(parameter.elements, find_elements(model, parameter), strict=True)
    return [name for name, body in bodies if model.body_simple[body]]


def check_elements(model: mujoco.MjModel, task: Task, parameter: Parameter) -> None:
    """Refuse a parameter of an element or a number that the model, or for a signal the task, does not have."""
    kind = parameter.kind.element
    if kind not in ("signal", "action"):
        check_field(model, parameter.field)
        for index in find_elements(model, parameter):
            check_written(model, parameter.field, index)
        return
    names = task.signals if kind == "signal" else [channel.name for channel in task.actions]
    for element in parameter.elements:
        if element not in names:
            values = "observation's" if kind == "signal" else "action's"
            hint = nearest_hint(element, names, none=f"none of its {values} values has a name")
            raise MadocError(f"{parameter.name}: {task.name} has no {kind} {element!r}; {hint}")


def find_elements(model: mujoco.MjModel, parameter: Parameter) -> list[int]:
    """Indices of a parameter's elements in the model; one -1 for gravity. A body may be named by a joint of its own."""
    kind = parameter.kind.element
    found = [-1] if kind is None else [_find_element(model, parameter.name, kind, one) for one in parameter.elements]
    if parameter.field.startswith(("drive_", "friction_", "gear_")):
        for element in found:
            _place_of(parameter.field)[0](model, element)  # refuses what has no such number
    return found


def _find_element(model: mujoco.MjModel, parameter_name: str, kind: str, element: str) -> int:
    index = mujoco.mj_name2id(model, _KINDS[kind][0], element)
    if index < 0 and kind == "body":
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, element)
        index = int(model.jnt_bodyid[joint]) if joint >= 0 else -1
    if index < 0:
        hint = nearest_hint(element, element_names(model, kind), none=f"it names no {kind}")
        raise MadocError(f"{parameter_name}: the model has no {kind} {element!r}; {hint}")
    return index


def element_names(model: mujoco.MjModel, kind: str) -> list[str]:
    """Names of the elements of a kind (`body`, `joint`, `geom`, `site` and so on) that have one."""
    object_type, count = _KINDS[kind]
    names = (mujoco.mj_id2name(model, object_type, index) for index in range(getattr(model, count)))
    return [name for name in names if name]


def single_joints(model: mujoco.MjModel) -> list[tuple[Any, bool]]:
    """Views of the joints that have a name and one degree of freedom, and whether each is a hinge.

    Deflections of gears, which no log shows, are none of them.
    """
    joints = (model.joint(index) for index in np.setdiff1d(np.arange(model.njnt), deflections(model)).tolist())
    return [
        (joint, int(joint.type[0]) == int(mujoco.mjtJoint.mjJNT_HINGE))
        for joint in joints
        if joint.name and len(joint.damping) == 1
    ]


def free_joints(model: mujoco.MjModel) -> list[Any]:
    """Views of the joints by which bodies move freely."""
    return [model.joint(index) for index in np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)).tolist()]


def body_reach(model: mujoco.MjModel, parameter: Parameter) -> float:
    """Largest distance from a body's origin, m, within a sphere about one of its geoms; infinite without geoms."""
    (body,) = find_elements(model, parameter)
    geoms = np.flatnonzero((model.geom_bodyid == body) & (model.geom_rbound > 0.0))
    far = np.linalg.norm(model.geom_pos[geoms], axis=1) + model.geom_rbound[geoms]
    return float(far.max(initial=0.0)) or np.inf


def heavy_bodies(model: mujoco.MjModel) -> Iterator[str]:
    """Names of bodies that move and have a mass; a body without a name takes that of its first joint."""
    bodies = element_names(model, "body")
    for body in range(1, model.nbody):
        if model.body_mass[body] <= 0.0 or model.body_weldid[body] == 0:
            continue
        name = model.body(body).name
        if not name and model.body_jntnum[body]:
            joint = model.joint(model.body_jntadr[body]).name
            name = "" if joint in bodies else joint
        if name:
            yield name


def linked_bodies(model: mujoco.MjModel) -> Iterator[tuple[str, float]]:
    """Names of bodies that hang on others that move, away from their origin, and how far from it they are, m."""
    for body in range(1, model.nbody):
        distance = float(np.linalg.norm(model.body_pos[body]))
        if model.body(body).name and distance > 0.0 and model.body_weldid[model.body_parentid[body]] != 0:
            yield model.body(body).name, distance


def _write_friction_loss(model: mujoco.MjModel, joint: int, value: float) -> None:
    least = LEAST_FRICTION if has_speed_or_load_friction(model, joint) else 0.0
    numbers_at(model, "dof_frictionloss", joint)[:] = max(value, least)


def has_gain(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator has a fixed gain; the first number of others is something else."""
    fixed = int(model.actuator_gaintype[actuator]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    return fixed and not has_numbers(model, actuator)


def _write_gain(model: mujoco.MjModel, actuator: int, value: float) -> None:
    """A servo pulls with gain · (target - position or velocity): the gain is in its bias too, with the other sign."""
    if not has_gain(model, actuator):
        raise MadocError(
            f"actuator_gain: the force of actuator {model.actuator(actuator).name!r} is not its command times a fixed "
            "gain (gaintype fixed in the model); leave it out, or model the drive as a motor"
        )
    gain, bias = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator]
    for term in (1, 2):  # of the position, of the velocity
        if gain != 0.0 and bias[term] == -gain and not bias[1:term].any():
            bias[term] = -value
            break
    model.actuator_gainprm[actuator, 0] = value


def _write_kv(model: mujoco.MjModel, actuator: int, value: float) -> None:
    """A position servo brakes with kv · velocity: the third number of its bias, with the other sign."""
    position, velocity = model.actuator_biasprm[actuator, 1:3]
    affine = int(model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    if not affine or (not position and velocity == -model.actuator_gainprm[actuator, 0]):
        raise MadocError(
            f"actuator_kv: actuator {model.actuator(actuator).name!r} is not a position servo; use dof_damping for the "
            "damping of its joint, or actuator_gain for the kv of a velocity servo"
        )
    model.actuator_biasprm[actuator, 2] = -value


def _write_ref(model: mujoco.MjModel, joint: int, value: float) -> None:
    """Limits and springs of the joint, and those of fixed tendons over it, stay where they are in space."""
    if int(model.jnt_type[joint]) not in ONE_DOF:
        raise MadocError(f"jnt_ref: joint {model.joint(joint).name!r} is a ball or free; only a hinge or slide has one")
    address = model.jnt_qposadr[joint]
    shift = value - model.qpos0[address]
    model.qpos0[address] = value
    model.qpos_spring[address] += shift
    if model.jnt_limited[joint]:
        model.jnt_range[joint] += shift
    for tendon in range(model.ntendon):
        wraps = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
        over = (model.wrap_type[wraps] == mujoco.mjtWrap.mjWRAP_JOINT) & (model.wrap_objid[wraps] == joint)
        longer = shift * model.wrap_prm[wraps][over].sum()
        model.tendon_lengthspring[tendon] += longer
        if model.tendon_limited[tendon]:
            model.tendon_range[tendon] += longer


def _write_distance(model: mujoco.MjModel, body: int, value: float) -> None:
    """A body stays in the direction in which it is from its parent's origin; one that is there has none."""
    distance = np.linalg.norm(model.body_pos[body])
    if distance == 0.0:
        raise MadocError(
            f"body_distance: body {model.body(body).name!r} is at the origin of its parent, so it has no direction to "
            "move in; place it in the model"
        )
    model.body_pos[body] *= value / distance


def _write_contact(place: int) -> Callable[[mujoco.MjModel, int, float], None]:
    """A writer of the time constant (place 0) or the damping ratio (1) of a geom's contacts; both are above 0."""

    def write(model: mujoco.MjModel, geom: int, value: float) -> None:
        if (model.geom_solref[geom] <= 0.0).any():
            raise MadocError(
                f"the solref of geom {model.geom(geom).name!r} is a stiffness and a damping, below 0 in the model, and "
                "has no time constant; give the geom a positive solref in the model"
            )
        model.geom_solref[geom, place] = max(value, SOLREF_FLOOR)

    return write


def _place_of(field: str) -> tuple["Numbers", "Write | None"]:
    """Where a field stands in a model: one of `FIELDS`, or a number by the name of its array."""
    if field in _PLACES:
        return _PLACES[field]
    return (
        lambda model, element: numbers_at(model, field, element),
        lambda model, element, value: write_number(model, field, element, value),
    )


Numbers = Callable[[mujoco.MjModel, int], np.ndarray]
Write = Callable[[mujoco.MjModel, int, float], None]
_PLACES: dict[str, tuple[Numbers, Write | None]] = {
    "gravity": (lambda model, _: model.opt.gravity[2:], None),
    "body_mass": (lambda model, body: model.body_mass[body : body + 1], write_mass),
    "body_mass_and_inertia": (lambda model, body: model.body_mass[body : body + 1], write_mass_and_inertia),
    "body_inertia": (lambda model, body: model.body_inertia[body].max(keepdims=True), write_inertia),
    "body_com": (lambda model, body: np.array([np.linalg.norm(model.body_ipos[body])]), write_centre_of_mass),
    "body_distance": (lambda model, body: np.array([np.linalg.norm(model.body_pos[body])]), _write_distance),
    **dict.fromkeys((*PAYLOAD, *INERTIA), (lambda model, body: np.zeros(1), None)),
    "dof_frictionloss": (lambda model, joint: numbers_at(model, "dof_frictionloss", joint), _write_friction_loss),
    "dof_drag": (lambda model, joint: model.dof_dampingpoly[rows_of(model, "dof_", joint), :1], None),
    "dof_damping": (lambda model, joint: model.dof_damping[rows_of(model, "dof_", joint)], None),
    "dof_armature": (lambda model, joint: model.dof_armature[rows_of(model, "dof_", joint)], None),
    "jnt_stiffness": (lambda model, joint: model.jnt_stiffness[joint : joint + 1], None),
    "jnt_ref": (lambda model, joint: model.qpos0[model.jnt_qposadr[joint] :][:1], _write_ref),
    "geom_friction": (lambda model, geom: model.geom_friction[geom, :1], None),
    "geom_friction_torsional": (lambda model, geom: model.geom_friction[geom, 1:2], None),
    "geom_friction_rolling": (lambda model, geom: model.geom_friction[geom, 2:], None),
    "contact_time": (lambda model, geom: model.geom_solref[geom, :1], _write_contact(0)),
    "contact_damping": (lambda model, geom: model.geom_solref[geom, 1:], _write_contact(1)),
    "actuator_gain": (lambda model, actuator: model.actuator_gainprm[actuator, :1], _write_gain),
    "actuator_kv": (lambda model, actuator: 0.0 - model.actuator_biasprm[actuator, 2:3], _write_kv),
    **{field: (partial(drive_number, name=field.partition("_")[2]), None) for field in FIELDS if "drive_" in field},
    **{
        field: (partial(friction_numbers, name=field.partition("_")[2]), None)
        for field in FIELDS
        if field[:9] == "friction_"
    },
    "gear_backlash": (backlash, write_backlash),
    "gear_stiffness": (partial(gear_numbers, name="stiffness"), None),
    "gear_damping": (partial(gear_numbers, name="damping"), None),
}
"""Where each field stands in a model: the numbers of an element, the first of which is its value, and what writes one.

Without a writer all of the numbers become the value; a writer is for a value that has a floor, or moves others along.
Payloads and deviations of inertias, 0 in the model, are written together.
"""
