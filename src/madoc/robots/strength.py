"""How strong the drives of a model's joints are, by what its file says or else by what they carry."""

import mujoco
import numpy as np

from madoc.robots.model import is_slide
from madoc.simulation.write import OF_A_JOINT, has_gain, single_joints

FREE = 6
"""Degrees of freedom of a body that moves freely."""
_REACH = 10.0
"""rad/s² (of a slide m/s²) that a drive reaches at least, where the model does not say how strong it is."""
_WEAKEST = 0.2
"""Strength of the weakest drive of a robot as a share of the strongest's of its kind, where the model says of neither:
wrists carry little, and are driven by motors that are not as much smaller."""


def is_servo(model: mujoco.MjModel, actuator: str) -> bool:
    """Whether an actuator holds a position: it pulls with a gain times the difference to its command."""
    index = model.actuator(actuator).id
    gain = float(model.actuator_gainprm[index, 0])
    return has_gain(model, index) and gain > 0.0 and float(model.actuator_biasprm[index, 1]) == -gain


def actuators_of(model: mujoco.MjModel, joint: int) -> list[int]:
    """The actuators that act on a joint."""
    on_joint = np.isin(model.actuator_trntype, OF_A_JOINT) & (model.actuator_trnid[:, 0] == joint)
    return [int(actuator) for actuator in np.flatnonzero(on_joint)]


def strengths(model: mujoco.MjModel) -> dict[str, tuple[float, bool]]:
    """By hinge and slide, the largest torque or force of its drive, N·m or N, and whether the model says it.

    Where it does not, that which holds what hangs on the joint and accelerates it.
    """
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    joints = [(joint.name, int(joint.id), hinge) for joint, hinge in single_joints(model)]
    needed = {name: _needed(model, data, index) for name, index, _ in joints}
    found = {}
    for name, index, hinge in joints:
        largest = max(needed[other] for other, _, alike in joints if alike == hinge)
        limit = _limit(model, index)
        found[name] = (limit, True) if limit else (max(needed[name], _WEAKEST * largest), False)
    return found


def _limit(model: mujoco.MjModel, joint: int) -> float:
    """The limit that the model gives a joint's drive; 0 where it gives none."""
    limits = [abs(model.jnt_actfrcrange[joint]).max()] if model.jnt_actfrclimited[joint] else []
    for actuator in actuators_of(model, joint):
        gear = abs(float(model.actuator_gear[actuator, 0]))
        if model.actuator_forcelimited[actuator]:
            limits.append(gear * abs(model.actuator_forcerange[actuator]).max())
        elif model.actuator_ctrllimited[actuator] and not model.actuator_biasprm[actuator].any():
            limits.append(gear * abs(model.actuator_gainprm[actuator, 0] * model.actuator_ctrlrange[actuator]).max())
    return min((float(limit) for limit in limits if limit > 0.0), default=0.0)


def _needed(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> float:
    """Torque or force that holds and accelerates what hangs on a joint; the legs of a free body carry all of it."""
    body = int(model.jnt_bodyid[joint])
    root = int(model.body_rootid[body])
    carried = root if model.body_dofnum[root] == FREE else body
    weight = float(model.body_subtreemass[carried]) * float(np.linalg.norm(model.opt.gravity))
    lever = 1.0 if is_slide(model, joint) else float(np.linalg.norm(data.subtree_com[body] - data.xanchor[joint]))
    return max(weight * lever, _REACH * float(model.dof_M0[model.jnt_dofadr[joint]]))
