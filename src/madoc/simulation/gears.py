"""Gears with backlash and elasticity: a joint between the shaft of a motor and its link.

The joint that a spec names is that of the motor's shaft behind the reduction, with armature, friction and actuators. A
second one in the same body, about the same axis, adds the deflection of the gear to it, so that the link stands at the
sum. A fixed tendon over the second joint alone is as long as the deflection; its spring has a dead band as wide as the
backlash, and its damper acts inside it too (the dead-zone model of Nordin and Gutman 2002, "Controlling mechanical
systems with backlash"). Joint and tendon have the name of the first joint with `SUFFIX`, by which they are found.
"""

import mujoco
import numpy as np
from jaxtyping import Float, Int

from madoc.errors import MadocError

SUFFIX = "_gear"
"""What the names of a gear's joint and tendon end with, behind that of the joint it belongs to."""


def deflections(model: mujoco.MjModel) -> Int[np.ndarray, " gears"]:
    """The joints that are deflections of gears."""
    names = [model.joint(joint).name for joint in range(model.njnt)]
    return np.array([joint for joint, name in enumerate(names) if name and _tendon(model, name) >= 0], np.int64)


def deflection_values(model: mujoco.MjModel) -> tuple[Int[np.ndarray, " gears"], Int[np.ndarray, " gears"]]:
    """Places in (qpos, qvel) of the deflections of gears, and of their velocities."""
    joints = deflections(model)
    return model.jnt_qposadr[joints].astype(np.int64), model.nq + model.jnt_dofadr[joints].astype(np.int64)


def loaded_deflections(
    model: mujoco.MjModel,
    states: Float[np.ndarray, "rows physical"],
    acceleration: Float[np.ndarray, "rows velocity"],
) -> Float[np.ndarray, "rows gears"]:
    """Deflections at which gears carry what accelerates and holds their links, in states without any.

    That torque follows from inverse dynamics. Where it pushes tells on which side of the backlash the teeth touch.
    """
    data, joints = mujoco.MjData(model), deflections(model)
    dofs, carried = model.jnt_dofadr[joints], np.zeros((len(states), len(joints)))
    for row, (state, change) in enumerate(zip(states, acceleration, strict=True)):
        data.qpos[:], data.qvel[:], data.qacc[:] = state[: model.nq], state[model.nq :], change
        mujoco.mj_inverse(model, data)
        carried[row] = data.qfrc_inverse[dofs]
    tendons = [_tendon(model, model.joint(joint).name) for joint in joints.tolist()]
    half = model.tendon_lengthspring[tendons, 1]
    deflected: np.ndarray = -(carried / model.tendon_stiffness[tendons] + half * np.sign(carried))
    return deflected


def longest_timestep(model: mujoco.MjModel, tendon: int, stiffness: float, damping: float) -> float:
    """Longest timestep that resolves the motor and the link swinging against each other in a gear, s.

    With it a swing takes 2π steps; with one of twice the length the integration, explicit in springs, diverges.
    """
    mobility = float(model.tendon_invweight0[tendon])
    return 1.0 / max(np.sqrt(stiffness * mobility), damping * mobility, 1e-12)


def gear_numbers(model: mujoco.MjModel, joint: int, name: str) -> np.ndarray:
    """The stiffness or damping of the gear behind a joint as a view of one value, or the ends of its dead band."""
    tendon = _tendon(model, f"{model.joint(joint).name}{SUFFIX}")
    if tendon < 0:
        raise MadocError(f"gear_{name}: joint {model.joint(joint).name!r} has no gear; say it under gears:")
    array: np.ndarray = {
        "stiffness": model.tendon_stiffness[tendon : tendon + 1],
        "damping": model.tendon_damping[tendon : tendon + 1],
        "backlash": model.tendon_lengthspring[tendon],
    }[name]
    return array


def backlash(model: mujoco.MjModel, joint: int) -> np.ndarray:
    """The whole width of the dead band of the gear behind a joint, shape (1,); a copy."""
    return np.diff(gear_numbers(model, joint, "backlash"))


def write_backlash(model: mujoco.MjModel, joint: int, value: float) -> None:
    """Half of the backlash lies to either side."""
    gear_numbers(model, joint, "backlash")[:] = -value / 2.0, value / 2.0


def _tendon(model: mujoco.MjModel, name: str) -> int:
    """The tendon of a gear's joint; -1 where there is none, or the name is no gear's."""
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TENDON, name) if name.endswith(SUFFIX) else -1
