"""Where a free base is and how fast it moves, where a log does not say so: from what touches the floor.

The lowest geom stands on what does not move, and the points that do so do not slip, so that their velocity J v is 0: a
leg's encoders and the base's attitude and gyroscope then tell the base's height and speed (Bloesch et al. 2012, "State
estimation for legged robots", with the contacts of the model for those of a detector). Both are guesses, from which the
start of a window is estimated. Places in the plane stay those of the model.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.simulation.velocities import hidden_values
from madoc.tasks.base import Task

STANDING = 0.01
"""Height of a point above the lowest one, relative to the base's own, up to which it counts as standing."""
_Pairs = tuple[tuple[int, int], ...]
_PLACINGS = 3
"""Number of times that a base is lowered by its distance; once is enough on a plane."""


@dataclass(frozen=True)
class Placed:
    """States of a log with free bases on the floor.

    Attributes:
        states: (qpos, qvel) of every row.
        found: Which values of (qpos, qvel) are not observed, and were found.
        heights: Those of them that are heights.
    """

    states: Float[np.ndarray, "rows physical"]
    found: Bool[np.ndarray, " physical"]
    heights: Int[np.ndarray, " bases"]


def on_the_floor(task: Task, states: Float[np.ndarray, "rows physical"]) -> Placed:
    """Put each free base whose attitude is observed, and whose place is not, on the floor.

    It is where the lowest of what can touch the world does, and its linear velocity is the one by which what stands
    there moves least. Bases that cannot touch the world are left. Positions that are NaN count as the model's own.
    """
    model, hidden = task.model, hidden_values(task)
    stood = np.where(np.isnan(states), np.append(model.qpos0, np.zeros(model.nv)), states)
    found, heights = np.zeros_like(hidden), []
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).tolist():
        position, velocity = int(model.jnt_qposadr[joint]), model.nq + int(model.jnt_dofadr[joint])
        place, speed = slice(position, position + 3), slice(velocity, velocity + 3)
        pairs = tuple(_touching(model, int(model.jnt_bodyid[joint])))
        if not pairs or not hidden[place].any() or hidden[position + 3 : position + 7].any():
            continue
        data, height = mujoco.MjData(model), position + 2 if hidden[position + 2] else None
        for state in stood:
            _stand(model, data, state, pairs, height)
            state[speed] = np.where(hidden[speed], _velocity(model, data, state, pairs, speed), state[speed])
        found[place], found[speed] = hidden[place], hidden[speed]
        heights += [] if height is None else [height]
    return Placed(np.where(found, stood, states), found, np.array(heights, np.int64))


def _touching(model: mujoco.MjModel, base: int) -> Iterator[tuple[int, int]]:
    """Pairs of a geom of the base's tree and one that does not move, that may collide."""
    fixed = np.flatnonzero(model.body_weldid[model.geom_bodyid] == 0).tolist()
    for geom in np.flatnonzero(model.body_rootid[model.geom_bodyid] == base).tolist():
        for other in fixed:
            here, there = (
                model.geom_contype[each] & model.geom_conaffinity[of] for each, of in ((geom, other), (other, geom))
            )
            if here or there:
                yield geom, other


def _stand(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    state: Float[np.ndarray, " physical"],
    pairs: _Pairs,
    height: int | None,
) -> None:
    """Compute where the state's bodies are, once the value that is its height has its lowest pair touch."""
    for _ in range(0 if height is None else _PLACINGS):
        data.qpos[:] = state[: model.nq]
        mujoco.mj_kinematics(model, data)
        distance = min(_gap(model, data, pair)[0] for pair in pairs)
        state[height] -= distance
        if abs(distance) < 1e-9:
            break
    data.qpos[:] = state[: model.nq]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)


def _velocity(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    state: Float[np.ndarray, " physical"],
    pairs: _Pairs,
    speed: slice,
) -> Float[np.ndarray, " 3"]:
    """The linear velocity of the base by which the points that stand move least."""
    gaps = [_gap(model, data, pair) for pair in pairs]
    lowest = min(gaps, key=lambda gap: gap[0])
    body = int(model.geom_bodyid[pairs[0][0]])
    base = data.xpos[model.body_rootid[body]]
    near = STANDING * np.linalg.norm(base - lowest[1])
    others, velocities = state[model.nq :].copy(), []
    others[speed.start - model.nq : speed.stop - model.nq] = 0.0
    jacobian = np.zeros((3, model.nv))
    for (gap, point), pair in zip(gaps, pairs, strict=True):
        if gap <= lowest[0] + near:
            mujoco.mj_jac(model, data, jacobian, None, point, model.geom_bodyid[pair[0]])
            velocities.append(-jacobian @ others)
    return np.mean(velocities, axis=0)


def _gap(model: mujoco.MjModel, data: mujoco.MjData, pair: tuple[int, int]) -> tuple[float, Float[np.ndarray, " 3"]]:
    """The signed distance of two geoms, and the point of the first that is nearest."""
    between = np.zeros(6)
    distance = mujoco.mj_geomDistance(model, data, *pair, 1e3, between)
    return float(distance), between[:3]
