"""What an observation does not show of a state: which values, velocities by differences, free bases by contacts.

The lowest geom of a free base stands on what does not move, and the points that do so do not slip, so that their
velocity J v is 0: a leg's encoders and the base's attitude and gyroscope then tell the base's height and speed (Bloesch
et al. 2012, "State estimation for legged robots", with the contacts of the model for those of a detector). Both are
guesses, from which the start of a window is estimated. Places in the plane stay those of the model.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.errors import MadocError
from madoc.simulation.attitudes import Tangent, differences
from madoc.tasks.base import Task

STANDING = 0.01
"""Height of a point above the lowest one, relative to the base's own, up to which it counts as standing."""
LEVEL, UPRIGHT = 0.01, 0.99
"""Largest vertical part of the axis of a base's slide in the plane, and smallest of one that is its height."""
_Pairs = tuple[tuple[int, int], ...]
_PLACINGS = 3
"""Number of times that a base is lowered by its distance; once is enough on a plane."""


def velocities_between(
    task: Task,
    before: Float[np.ndarray, "rows state"],
    after: Float[np.ndarray, "rows state"],
    steps: Float[np.ndarray, " rows"],
) -> Float[np.ndarray, "rows velocity"]:
    """The constant velocities that lead from the positions of `before` to those of `after`, `steps` >= 1 later."""
    model = task.model
    seconds = steps * task.frame_skip * model.opt.timestep
    start, end = before[:, : model.nq], after[:, : model.nq]
    if model.nq == model.nv:
        return (end - start) / seconds[:, None]
    tangent = Tangent.of(model)
    apart = differences(tangent.attitudes, end, start)
    for _, *turn in tangent.attitudes:  # n sin(θ/2), for n θ/2
        size = np.linalg.norm(apart[:, turn], axis=1, keepdims=True)
        apart[:, turn] *= np.arcsin(np.minimum(size, 1.0)) / np.where(size > 0.0, size, 1.0)
    return tangent.halves * apart[:, tangent.places] / seconds[:, None]


def with_velocities(
    task: Task, states: Float[np.ndarray, "rows state"], velocities: Float[np.ndarray, "rows velocity"]
) -> Float[np.ndarray, "rows state"]:
    """(qpos, qvel) with the given velocities where the state has NaN."""
    positions = task.model.nq
    padded = np.concatenate([states[:, :positions], np.nan_to_num(velocities)], axis=-1)
    return np.where(np.isnan(states), padded, states)


def hidden_values(task: Task) -> Bool[np.ndarray, " state"]:
    """Which values of (qpos, qvel) an observation does not determine, for a task with a `posture`."""
    assert task.posture is not None
    return np.isnan(np.asarray(task.posture(np.zeros(task.observation_size))))


def missing_velocities(task: Task) -> Int[np.ndarray, " velocities"]:
    """Indices in a state of the velocities that an observation does not determine, for a task with a `posture`."""
    positions = task.model.nq
    return positions + np.flatnonzero(hidden_values(task)[positions:])


def unseen_values(task: Task) -> Bool[np.ndarray, " positions"]:
    """Which values of qpos an observation does not show, for a task with a `posture`."""
    model = task.model
    blind = hidden_values(task)[: model.nq]
    if task.sense is None:
        state = np.concatenate([model.qpos0, np.zeros(model.nv)])
        moved = state + 1e-3 * np.eye(len(state))[: model.nq]
        blind |= (np.asarray(task.observe(moved)) == np.asarray(task.observe(state))).all(-1)
    return blind


def unseen_positions(task: Task) -> tuple[str, ...]:
    """Joints whose position an observation does not show completely, so that differences do not give their velocity."""
    if task.posture is None:
        return ()
    model = task.model
    joints = np.add.reduceat(unseen_values(task).astype(int), model.jnt_qposadr).nonzero()[0]
    return tuple(model.joint(index).name or f"joint {index}" for index in joints.tolist())


def refuse_unseen_positions(task: Task) -> None:
    """Raise a `MadocError` that names the joints whose position, and so whose velocity, is not observed."""
    joints = unseen_positions(task)
    if joints:
        raise MadocError(
            f"an observation of {task.name} does not show the position of {', '.join(joints)}, so its velocity cannot "
            "be computed from positions; use least-squares, which estimates it, or madoc with starts=policy"
        )


@dataclass(frozen=True)
class Placed:
    """States (qpos, qvel) of a log with free bases on the floor: which values were found, and which are heights."""

    states: Float[np.ndarray, "rows physical"]
    found: Bool[np.ndarray, " physical"]
    heights: Int[np.ndarray, " bases"]


def on_the_floor(task: Task, states: Float[np.ndarray, "rows physical"]) -> Placed:
    """Put each base whose attitude is observed, and whose place is not, on the floor.

    It is where the lowest of what can touch the world does, and its linear velocity is the one by which what stands
    there moves least. Bases that cannot touch the world are left. Positions that are NaN count as the model's own.
    """
    model, hidden, unseen = task.model, hidden_values(task), unseen_values(task)
    stood = np.where(np.isnan(states), np.append(model.qpos0, np.zeros(model.nv)), states)
    found, heights = np.zeros_like(hidden), []
    for body in np.flatnonzero(model.body_parentid[1:] == 0).tolist():
        base = _Base.of(model, body + 1)
        place = np.array([each for each in base.place if unseen[each]], np.int64)
        moves = [unseen[at] and hidden[speed] for at, speed in zip(base.place, base.speed, strict=True)]
        speed, pairs = np.array(base.speed, np.int64)[moves], tuple(_touching(model, body + 1))
        if not pairs or not len(place) or unseen[base.attitude].any():
            continue
        data, height = mujoco.MjData(model), next((each for each in base.heights if unseen[each]), None)
        for state in stood:
            _stand(model, data, state, pairs, height)
            state[speed] = _velocity(model, data, state, pairs, speed)
        found[place] = found[speed] = True
        heights += [] if height is None else [height]
    return Placed(np.where(found, stood, states), found, np.array(heights, np.int64))


@dataclass(frozen=True)
class _Base:
    """Indices in (qpos, qvel) of a base's place, its linear velocity and its attitude, and of places that are heights.

    It has a free joint, or hinges and slides along or across the vertical that nothing drives or holds, as a planar
    robot has; other slides are no base's.
    """

    place: list[int]
    speed: list[int]
    attitude: list[int]
    heights: list[int]

    @classmethod
    def of(cls, model: mujoco.MjModel, body: int) -> "_Base":
        base, first = cls([], [], [], []), model.body_jntadr[body]
        for joint in range(first, first + model.body_jntnum[body]):
            kind, at, speed = model.jnt_type[joint], int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            free, slides = bool(kind == mujoco.mjtJoint.mjJNT_FREE), bool(kind == mujoco.mjtJoint.mjJNT_SLIDE)
            upright = _upright(model, body, joint) if slides else 0.0
            if slides and (_held(model, joint) or LEVEL < abs(upright) < UPRIGHT or upright < -UPRIGHT):
                return cls([], [], [], [])
            places = 3 * free + slides
            base.place.extend(range(at, at + places))
            base.speed.extend(range(model.nq + speed, model.nq + speed + places))
            turns = 0 if slides else 4 if free or kind == mujoco.mjtJoint.mjJNT_BALL else 1
            base.attitude.extend(range(at + places, at + places + turns))
            base.heights.extend([at + 2] * free + [at] * (upright >= UPRIGHT))
        return base


def _upright(model: mujoco.MjModel, body: int, joint: int) -> float:
    """The vertical part, in [-1, 1], of the axis of a joint of a body on the world."""
    axis = np.zeros(3)
    mujoco.mju_rotVecQuat(axis, model.jnt_axis[joint], model.body_quat[body])
    return float(axis[2])


def _held(model: mujoco.MjModel, joint: int) -> bool:
    """Whether an actuator, a spring or a limit acts on a joint."""
    driven = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == joint)
    return bool(driven.any() or model.jnt_stiffness[joint] or model.jnt_limited[joint])


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
    speed: Int[np.ndarray, " speeds"],
) -> Float[np.ndarray, " speeds"]:
    """The linear velocity of the base by which the points that stand move least."""
    gaps = [_gap(model, data, pair) for pair in pairs]
    lowest = min(gaps, key=lambda gap: gap[0])
    body = int(model.geom_bodyid[pairs[0][0]])
    base = data.xpos[model.body_rootid[body]]
    near = STANDING * np.linalg.norm(base - lowest[1])
    others, unknown, rows = state[model.nq :].copy(), speed - model.nq, []
    others[unknown] = 0.0
    for (gap, point), pair in zip(gaps, pairs, strict=True):
        if gap <= lowest[0] + near:
            rows.append(np.zeros((3, model.nv)))
            mujoco.mj_jac(model, data, rows[-1], None, point, model.geom_bodyid[pair[0]])
    jacobian = np.concatenate(rows)
    return np.linalg.lstsq(jacobian[:, unknown], -jacobian @ others)[0]


def _gap(model: mujoco.MjModel, data: mujoco.MjData, pair: tuple[int, int]) -> tuple[float, Float[np.ndarray, " 3"]]:
    """The signed distance of two geoms, and the point of the first that is nearest."""
    between = np.zeros(6)
    distance = mujoco.mj_geomDistance(model, data, *pair, 1e3, between)
    return float(distance), between[:3]
