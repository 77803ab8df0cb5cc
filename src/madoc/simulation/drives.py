"""What actuators of joints exert, by their own equations, for many states at once."""

import mujoco
import numpy as np
from jaxtyping import Float

from madoc.simulation.write import OF_A_JOINT, ONE_DOF, has_gain

_BIASES = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
"""Biases of motors, and of position and velocity servos."""


def joint_drives(
    model: mujoco.MjModel, state: Float[np.ndarray, "rows state"], control: Float[np.ndarray, "rows actuator"]
) -> Float[np.ndarray, "rows dof"]:
    """The force on each degree of freedom by actuators of hinges and slides, in N or N·m.

    States are (qpos, qvel, ...). Actuators of other transmissions, gains or biases than those of motors and servos are
    left out, and so is gravity compensation by actuators. Controls and forces are cut off where the model does so.
    """
    forces = np.zeros((len(state), model.nv))
    clamped = not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    for index in range(model.nu):
        joint, given = int(model.actuator_trnid[index, 0]), control[:, index]
        usual = (
            model.actuator_trntype[index] in OF_A_JOINT
            and has_gain(model, index)
            and model.actuator_biastype[index] in _BIASES
        )
        if not usual or model.jnt_type[joint] not in ONE_DOF:
            continue
        if clamped and model.actuator_ctrllimited[index]:
            given = np.clip(given, *model.actuator_ctrlrange[index])
        gear, dof, bias = (
            float(model.actuator_gear[index, 0]),
            int(model.jnt_dofadr[joint]),
            model.actuator_biasprm[index],
        )
        length, speed = gear * state[:, int(model.jnt_qposadr[joint])], gear * state[:, model.nq + dof]
        force = model.actuator_gainprm[index, 0] * given + bias[0] + bias[1] * length + bias[2] * speed
        if model.actuator_forcelimited[index]:
            force = np.clip(force, *model.actuator_forcerange[index])
        forces[:, dof] += gear * force
    for joint in np.flatnonzero(model.jnt_actfrclimited).tolist():
        if model.jnt_type[joint] in ONE_DOF:
            dof = int(model.jnt_dofadr[joint])
            forces[:, dof] = np.clip(forces[:, dof], *model.jnt_actfrcrange[joint])
    return forces
