"""Velocities from positions: the change of a joint's position, or of its quaternion, over time."""

import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.errors import MadocError
from madoc.simulation.attitudes import Tangent, differences
from madoc.tasks.base import Task


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
