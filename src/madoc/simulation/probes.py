"""What a model does and shows at given states: contacts, forces of actuators, sensors that are sums of the state."""

import copy
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import mujoco
import numpy as np
from jaxtyping import Float

_OF_CONSTRAINTS = tuple(
    int(getattr(mujoco.mjtSensor, f"mjSENS_{name}"))
    for name in ("JOINTLIMITPOS", "JOINTLIMITVEL", "TENDONLIMITPOS", "TENDONLIMITVEL", "USER", "PLUGIN")
)
"""Sensors that may show constraints though they belong to positions or velocities."""
_TRIED = 8
"""Number of states beyond those that determine the weights; a sensor that is no weighted sum differs in one of them."""
_EXACT = 1e-9
"""Largest error of a weighted sum, relative to the sensor's largest reading; weights below it are rounding."""


def collided(
    model: mujoco.MjModel, data: mujoco.MjData, states: Float[np.ndarray, "rows state"]
) -> Iterator[mujoco.MjData]:
    """The data with the contacts of each state in turn, of which geometry alone decides."""
    for position in states[:, : model.nq]:
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        yield data


def touching_geoms(model: mujoco.MjModel, states: Float[np.ndarray, "rows state"]) -> tuple[str, ...]:
    """Names of the geoms of moving bodies that are in contact in any of the states, in the order of the model.

    Where one of a pair has no name, or neither moves, the other's name stands for the contact.
    """
    found = set[int]()
    moves = model.body_weldid[model.geom_bodyid] != 0
    named = np.array([bool(model.geom(index).name) for index in range(model.ngeom)])
    for data in collided(model, mujoco.MjData(model), states):
        for pair in data.contact.geom.reshape(-1, 2):
            known = pair[named[pair]]
            found.update((known[moves[known]] if moves[known].any() else known).tolist())
    return tuple(model.geom(index).name for index in sorted(found))


@contextmanager
def sensing_motion(models: Sequence[mujoco.MjModel]) -> Iterator[None]:
    """Leave constraints out of steps that are for sensors alone, where these show positions and velocities.

    Contacts and limits are most of a step's work. Models with sensors of forces or accelerations stay as they are; all
    of them have the same sensors.
    """
    of_forces = models[0].sensor_needstage > int(mujoco.mjtStage.mjSTAGE_VEL)
    if of_forces.any() or np.isin(models[0].sensor_type, _OF_CONSTRAINTS).any():
        yield
        return
    before = [model.opt.disableflags for model in models]
    for model in models:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    try:
        yield
    finally:
        for model, flags in zip(models, before, strict=True):
            model.opt.disableflags = flags


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


def linear_sensors(model: mujoco.MjModel) -> dict[int, Float[np.ndarray, "values physical"]]:
    """By the address of its first value, the weights of (qpos, qvel) in each sensor that is a weighted sum of them.

    They are found at random states, of which quaternions have length 1: a gyroscope and an attitude that are fixed to
    a free body are such sums, a velocimeter is none.
    """
    positional = (int(mujoco.mjtStage.mjSTAGE_POS), int(mujoco.mjtStage.mjSTAGE_VEL))
    sensors = [index for index in range(model.nsensor) if int(model.sensor_needstage[index]) in positional]
    if not sensors:
        return {}
    states, readings = _random_readings(model)
    found = {}
    for index in sensors:
        first, count = int(model.sensor_adr[index]), int(model.sensor_dim[index])
        seen = readings[:, first : first + count]
        weights = np.linalg.lstsq(states, seen, rcond=None)[0]
        limit = _EXACT * np.abs(seen).max()
        if limit > 0.0 and np.abs(states @ weights - seen).max() <= limit:
            found[first] = np.where(np.abs(weights) > _EXACT, weights, 0.0).T
    return found


def _random_readings(
    model: mujoco.MjModel,
) -> tuple[Float[np.ndarray, "states physical"], Float[np.ndarray, "states sensordata"]]:
    """States of no particular pose or speed, always the same, and what sensors read there."""
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    states = random.standard_normal((model.nq + model.nv + _TRIED, model.nq + model.nv))
    readings = np.zeros((len(states), model.nsensordata))
    for state, reading in zip(states, readings, strict=True):
        mujoco.mj_normalizeQuat(model, state[: model.nq])
        data.qpos[:], data.qvel[:] = state[: model.nq], state[model.nq :]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_sensorPos(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_sensorVel(model, data)
        reading[:] = data.sensordata
    return states, readings
