"""Parameters into a MuJoCo model: elements found by name, values written, derived constants recomputed."""

from collections.abc import Callable, Sequence
from difflib import get_close_matches

import mujoco
import numpy as np

from madoc.errors import MadocError
from madoc.parameters import FIELDS, Parameter

MASS_FLOOR = 1e-3
"""kg. A massless body explodes, and the paper's ranges start at 0."""

INERTIA_FLOOR = 1e-9
"""kg·m². A body without inertia explodes."""

_OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
}

_INERTIAL_FRAMES = (mujoco.mjtSameFrame.mjSAMEFRAME_INERTIA, mujoco.mjtSameFrame.mjSAMEFRAME_INERTIAROT)


def write_parameters(
    model: mujoco.MjModel, data: mujoco.MjData, parameters: Sequence[Parameter], values: np.ndarray
) -> None:
    """Write physical values (d,) into a model in place, then recompute what depends on them (`mj_setConst`).

    Raises:
        MadocError: A parameter names an element that the model does not have, or scales a mass of 0.
    """
    for parameter, value in zip(parameters, values, strict=True):
        if FIELDS[parameter.field].in_model:
            for element in find_elements(model, parameter):
                _WRITERS[parameter.field](model, element, float(value))
    mujoco.mj_setConst(model, data)


def nominal_values(model: mujoco.MjModel, parameter: Parameter) -> tuple[float, ...]:
    """What a model has where a parameter would be written, one value an element; 0 for a delay and for biases.

    Raises:
        MadocError: The model has no such element.
    """
    if not FIELDS[parameter.field].in_model:
        return tuple(0.0 for _ in parameter.elements or (0,))
    return tuple(float(_READERS[parameter.field](model, element)) for element in find_elements(model, parameter))


def find_elements(model: mujoco.MjModel, parameter: Parameter) -> list[int]:
    """Indices of a parameter's elements in the model; one -1 for gravity.

    A body may be named by a joint of its own.

    Raises:
        MadocError: The model has no such element; the message lists the nearest names.
    """
    kind = FIELDS[parameter.field].element
    if kind is None:
        return [-1]
    return [_find_element(model, parameter.name, kind, element) for element in parameter.elements]


def _find_element(model: mujoco.MjModel, parameter_name: str, kind: str, element: str) -> int:
    index = mujoco.mj_name2id(model, _OBJECTS[kind], element)
    if index < 0 and kind == "body":
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, element)
        index = int(model.jnt_bodyid[joint]) if joint >= 0 else -1
    if index < 0:
        names = element_names(model, kind)
        near = nearest_names(element, names) or names[:8]
        listed = f"nearest: {', '.join(near)}" if near else f"it names no {kind}"
        raise MadocError(f"{parameter_name}: the model has no {kind} {element!r}; {listed}")
    return index


def element_names(model: mujoco.MjModel, kind: str) -> list[str]:
    """Names of all elements of a kind (`body`, `joint`, `geom`, `actuator`)."""
    count = {"body": model.nbody, "joint": model.njnt, "geom": model.ngeom, "actuator": model.nu}[kind]
    names = (mujoco.mj_id2name(model, _OBJECTS[kind], index) for index in range(count))
    return [name for name in names if name]


def nearest_names(wanted: str, names: list[str]) -> list[str]:
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
        name = _name(model, body)
        raise MadocError(f"body_mass_and_inertia: body {name!r} has no mass to scale; use body_mass instead")
    model.body_inertia[body] *= mass / model.body_mass[body]
    model.body_mass[body] = mass


def _body_inertia(model: mujoco.MjModel, body: int, value: float) -> None:
    largest = model.body_inertia[body].max()
    if largest == 0.0:
        raise MadocError(f"body_inertia: body {_name(model, body)!r} has no inertia to scale; give it one in the model")
    model.body_inertia[body] *= max(value, INERTIA_FLOOR) / largest


def _body_com(model: mujoco.MjModel, body: int, value: float) -> None:
    distance = np.linalg.norm(model.body_ipos[body])
    if distance == 0.0:
        raise MadocError(
            f"body_com: the centre of mass of body {_name(model, body)!r} is at its origin, so it has no direction to "
            "move in; place it in the model"
        )
    before = model.body_ipos[body].copy()
    model.body_ipos[body] *= value / distance
    _keep_shapes(model, body, model.body_ipos[body] - before)


def _keep_shapes(model: mujoco.MjModel, body: int, moved: np.ndarray) -> None:
    """Leave geoms and sites where they are: MuJoCo keeps some of them, and boxes around them, in the inertial frame."""
    for owner, frame in ((model.geom_bodyid, model.geom_sameframe), (model.site_bodyid, model.site_sameframe)):
        in_inertial_frame = (owner == body) & np.isin(frame, _INERTIAL_FRAMES)
        frame[in_inertial_frame] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    first, count = model.body_bvhadr[body], model.body_bvhnum[body]
    if count:
        back, turned = np.zeros(4), np.zeros(3)
        mujoco.mju_negQuat(back, model.body_iquat[body])
        mujoco.mju_rotVecQuat(turned, moved, back)
        model.bvh_aabb[first : first + count, :3] -= turned


def _name(model: mujoco.MjModel, body: int) -> str:
    return mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body) or ""


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
    """A servo pulls with gain · (target - what it has): the gain is in its bias as well, with the other sign."""
    gain, bias = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator]
    for term in (1, 2):  # of the position, of the velocity
        if gain != 0.0 and bias[term] == -gain and not bias[1:term].any():
            bias[term] = -value
            break
    model.actuator_gainprm[actuator, 0] = value


def _first_dof(model: mujoco.MjModel, joint: int) -> int:
    return int(model.jnt_dofadr[joint])


_WRITERS: dict[str, Callable[[mujoco.MjModel, int, float], None]] = {
    "gravity": _gravity,
    "body_mass": _body_mass,
    "body_mass_and_inertia": _body_mass_and_inertia,
    "body_inertia": _body_inertia,
    "body_com": _body_com,
    "dof_damping": _dof_damping,
    "dof_armature": _dof_armature,
    "dof_frictionloss": _dof_frictionloss,
    "jnt_stiffness": _jnt_stiffness,
    "geom_friction": _geom_friction,
    "actuator_gain": _actuator_gain,
}

_READERS: dict[str, Callable[[mujoco.MjModel, int], float]] = {
    "gravity": lambda model, _: model.opt.gravity[2],
    "body_mass": lambda model, body: model.body_mass[body],
    "body_mass_and_inertia": lambda model, body: model.body_mass[body],
    "body_inertia": lambda model, body: model.body_inertia[body].max(),
    "body_com": lambda model, body: float(np.linalg.norm(model.body_ipos[body])),
    "dof_damping": lambda model, joint: model.dof_damping[_first_dof(model, joint)],
    "dof_armature": lambda model, joint: model.dof_armature[_first_dof(model, joint)],
    "dof_frictionloss": lambda model, joint: model.dof_frictionloss[_first_dof(model, joint)],
    "jnt_stiffness": lambda model, joint: model.jnt_stiffness[joint],
    "geom_friction": lambda model, geom: model.geom_friction[geom, 0],
    "actuator_gain": lambda model, actuator: model.actuator_gainprm[actuator, 0],
}
