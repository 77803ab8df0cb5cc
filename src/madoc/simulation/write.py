"""Parameters into a MuJoCo model: elements found by name, values written, derived constants recomputed."""

from collections.abc import Callable, Sequence
from difflib import get_close_matches

import mujoco
import numpy as np

from madoc.errors import MadocError
from madoc.parameters import FIELDS, Parameter

MASS_FLOOR = 1e-3
"""kg. A massless body explodes, and the paper's ranges start at 0."""

_OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
}


def write_parameters(
    model: mujoco.MjModel, data: mujoco.MjData, parameters: Sequence[Parameter], values: np.ndarray
) -> None:
    """Write physical values (d,) into a model in place, then recompute what depends on them (`mj_setConst`).

    Raises:
        MadocError: A parameter names an element that the model does not have, or scales a mass of 0.
    """
    for parameter, value in zip(parameters, values, strict=True):
        _WRITERS[parameter.field](model, find_element(model, parameter), float(value))
    mujoco.mj_setConst(model, data)


def find_element(model: mujoco.MjModel, parameter: Parameter) -> int:
    """Index of a parameter's element in the model; -1 for gravity.

    A body may be named by a joint of its own.

    Raises:
        MadocError: The model has no such element; the message lists the nearest names.
    """
    kind = FIELDS[parameter.field].element
    if kind is None:
        return -1
    index = mujoco.mj_name2id(model, _OBJECTS[kind], parameter.element)
    if index < 0 and kind == "body":
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, parameter.element)
        index = int(model.jnt_bodyid[joint]) if joint >= 0 else -1
    if index < 0:
        names = element_names(model, kind)
        near = _nearest(parameter.element, names) or names[:8]
        raise MadocError(f"{parameter.name}: the model has no {kind} {parameter.element!r}; nearest: {', '.join(near)}")
    return index


def element_names(model: mujoco.MjModel, kind: str) -> list[str]:
    """Names of all elements of a kind (`body`, `joint`, `geom`, `actuator`)."""
    count = {"body": model.nbody, "joint": model.njnt, "geom": model.ngeom, "actuator": model.nu}[kind]
    names = (mujoco.mj_id2name(model, _OBJECTS[kind], index) for index in range(count))
    return [name for name in names if name]


def _nearest(wanted: str, names: list[str]) -> list[str]:
    """At most three: names that hold the wanted one first, then those spelled like it."""
    close = get_close_matches(wanted, names, n=3, cutoff=0.4)
    return list(dict.fromkeys([*(name for name in names if wanted in name), *close]))[:3]


def _dofs(model: mujoco.MjModel, joint: int) -> slice:
    """The degrees of freedom of a joint: 6 of a free one, 3 of a ball, 1 of any other."""
    return slice(model.jnt_dofadr[joint], model.jnt_dofadr[joint] + len(model.joint(joint).damping))


def _gravity(model: mujoco.MjModel, _: int, value: float) -> None:
    model.opt.gravity[2] = value


def _body_mass(model: mujoco.MjModel, body: int, value: float) -> None:
    model.body_mass[body] = max(value, MASS_FLOOR)


def _body_mass_and_inertia(model: mujoco.MjModel, body: int, value: float) -> None:
    mass = max(value, MASS_FLOOR)
    if model.body_mass[body] == 0.0:
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body)
        raise MadocError(f"body_mass_and_inertia: body {name!r} has no mass to scale; use body_mass instead")
    model.body_inertia[body] *= mass / model.body_mass[body]
    model.body_mass[body] = mass


def _dof_damping(model: mujoco.MjModel, joint: int, value: float) -> None:
    model.dof_damping[_dofs(model, joint)] = value


def _dof_armature(model: mujoco.MjModel, joint: int, value: float) -> None:
    model.dof_armature[_dofs(model, joint)] = value


def _dof_frictionloss(model: mujoco.MjModel, joint: int, value: float) -> None:
    model.dof_frictionloss[_dofs(model, joint)] = value


def _jnt_stiffness(model: mujoco.MjModel, joint: int, value: float) -> None:
    model.jnt_stiffness[joint] = value


def _geom_friction(model: mujoco.MjModel, geom: int, value: float) -> None:
    model.geom_friction[geom, 0] = value


def _actuator_gain(model: mujoco.MjModel, actuator: int, value: float) -> None:
    model.actuator_gainprm[actuator, 0] = value


_WRITERS: dict[str, Callable[[mujoco.MjModel, int, float], None]] = {
    "gravity": _gravity,
    "body_mass": _body_mass,
    "body_mass_and_inertia": _body_mass_and_inertia,
    "dof_damping": _dof_damping,
    "dof_armature": _dof_armature,
    "dof_frictionloss": _dof_frictionloss,
    "jnt_stiffness": _jnt_stiffness,
    "geom_friction": _geom_friction,
    "actuator_gain": _actuator_gain,
}
