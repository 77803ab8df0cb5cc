"""Any number of a MuJoCo model by the name of its array: where it stands, what may not be written, and writing it."""

import copy

import mujoco
import numpy as np

from madoc.errors import MadocError, nearest_hint
from madoc.parameters import FIELDS, array_of

_NOT_FREE = {
    "opt.timestep": "the timestep is given by timestep: in the spec",
    "body_ipos": "shapes may stand in the inertial frame, which it is the place of; use payload_x or inertia",
    "body_inertia": "the moments of inertia of a body bound each other; use the field inertia",
    "geom_size": "bounds of shapes are computed when a model is compiled; change the size in the model's file",
    "geom_aabb": "bounds of shapes are computed when a model is compiled; change the size in the model's file",
    "geom_rbound": "bounds of shapes are computed when a model is compiled; change the size in the model's file",
    "jnt_axis": "a direction has a length of 1, so that its numbers are not free; turn it in the model's file",
}
"""Arrays whose numbers cannot be calibrated one by one, and why."""
_QUATERNION = "a quaternion has a length of 1, so that its numbers are not free; turn it in the model's file"
_PLACED = {"geom_pos": "geom_sameframe", "site_pos": "site_sameframe"}
"""Arrays of places, and the flags by which MuJoCo takes another frame's place instead."""


def numbers_at(model: mujoco.MjModel, field: str, element: int) -> np.ndarray:
    """A view of the numbers of an element that a field such as `geom_solref[0]` names; of an option, of that."""
    array, index = array_of(field)
    if array.startswith("opt."):
        return np.atleast_1d(getattr(model.opt, array.removeprefix("opt.")))[index or 0 :][:1]
    rows = getattr(model, array)[rows_of(model, array, element)]
    return rows if index is None else rows[:, index]


def write_number(model: mujoco.MjModel, field: str, element: int, value: float) -> None:
    """Write a value into the numbers of an element; shapes that are moved are looked at one by one from then on."""
    array, _ = array_of(field)
    option = array.removeprefix("opt.")
    if option != array and np.ndim(getattr(model.opt, option)) == 0:
        setattr(model.opt, option, value)
    else:
        numbers_at(model, field, element)[:] = value
    if array in _PLACED:
        getattr(model, _PLACED[array])[element] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE


def check_field(model: mujoco.MjModel, field: str) -> None:
    """Refuse a field that is neither in `FIELDS` nor a number of the model that can be written.

    Raises:
        MadocError: The array or option is unknown, its numbers are not free or are whole, or it has no such index.
    """
    if field in FIELDS:
        return
    array, index = array_of(field)
    option = array.startswith("opt.")
    owner, name = (model.opt, array.removeprefix("opt.")) if option else (model, array)
    held = getattr(owner, name, None) if hasattr(type(owner), name) else None
    if not isinstance(held, float) and not (isinstance(held, np.ndarray) and held.dtype.kind == "f" and held.size):
        known = option_names(model) if option else array_names(model)
        raise MadocError(f"MuJoCo's model has no numbers {array!r}; {nearest_hint(name, known)}")
    reason = _QUATERNION if array.endswith("quat") else _NOT_FREE.get(array)
    if reason is not None:
        raise MadocError(f"{array} cannot be calibrated: {reason}")
    shape = np.shape(held)[0 if option else 1 :]
    if (index is None) != (shape == ()) or (shape and (index or 0) >= shape[0]):
        wanted = f"index: from 0 to {shape[0] - 1}" if shape else "no index:"
        raise MadocError(f"expected {wanted} with {array}, got {'none' if index is None else index}")


def check_written(model: mujoco.MjModel, field: str, element: int) -> None:
    """Refuse a number that MuJoCo computes from others, as a subtree's mass: it would be lost after it is written."""
    if field in FIELDS:
        return
    changed = copy.copy(model)
    wanted = 1.5 * float(numbers_at(model, field, element).flat[0]) + 0.125
    write_number(changed, field, element, wanted)
    mujoco.mj_setConst(changed, mujoco.MjData(changed))
    if not np.allclose(numbers_at(changed, field, element), wanted, rtol=1e-6):
        raise MadocError(f"{field} cannot be calibrated: MuJoCo computes it from other numbers; calibrate those")


def rows_of(model: mujoco.MjModel, array: str, element: int) -> slice:
    """The rows of an element in an array; a joint has one for each position or degree of freedom where those count."""
    if array.startswith("dof_"):
        return slice(model.jnt_dofadr[element], model.jnt_dofadr[element] + len(model.joint(element).damping))
    if array.startswith("qpos"):
        return slice(model.jnt_qposadr[element], model.jnt_qposadr[element] + len(model.joint(element).qpos0))
    return slice(element, element + 1)


def option_names(model: mujoco.MjModel) -> list[str]:
    """Names of the options of a model that are floating-point numbers."""
    return [name for name in dir(model.opt) if isinstance(getattr(model.opt, name), float | np.ndarray)]


def array_names(model: mujoco.MjModel) -> list[str]:
    """Names of the arrays of a model that have an element's number."""
    public = [name for name in dir(model) if not name.startswith("_")]
    arrays = {name: getattr(model, name) for name in public}
    return [name for name, held in arrays.items() if isinstance(held, np.ndarray) and held.dtype.kind == "f"]
