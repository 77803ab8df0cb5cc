"""What each actuator exerts on every degree of freedom, for many states at once."""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float


def drive_forces(
    models: Sequence[mujoco.MjModel],
    state: Float[np.ndarray, "rows state"],
    control: Float[np.ndarray, "rows actuator"],
) -> Float[np.ndarray, "rows actuator dof"]:
    """Generalised forces of each actuator at the start of a step, in N or N·m, whatever it acts on.

    Each row has a model, all of one structure; states are (qpos, qvel, ...). Controls and forces are cut off where the
    model does so; at a joint whose actuators together are cut off, all are in proportion.
    """
    data, forces = mujoco.MjData(models[0]), np.zeros((len(state), models[0].nu, models[0].nv))
    for row, (model, values, given) in enumerate(zip(models, state, control, strict=True)):
        data.qpos[:], data.qvel[:] = values[: model.nq], values[model.nq : model.nq + model.nv]
        data.ctrl[:] = given
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_fwdActuation(model, data)
        mujoco.mju_sparse2dense(
            forces[row], data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
        )
        forces[row] *= data.actuator_force[:, None]
    model = models[0]  # no parameter changes what joints limit
    for joint in np.flatnonzero(model.jnt_actfrclimited).tolist():
        dof = int(model.jnt_dofadr[joint])
        total = forces[..., dof].sum(1)
        share = np.clip(total, *model.jnt_actfrcrange[joint]) / np.where(total == 0.0, 1.0, total)
        forces[..., dof] *= share[:, None]
    return forces
