"""Sensors that show values of a state as they are: encoders, a base's attitude and gyro, tendons' lengths."""

import copy

import mujoco
import numpy as np
from jaxtyping import Float

_TRIED = 8
"""Number of states beyond those that determine the weights; a sensor that is no weighted sum differs in one of them."""
_EXACT = 1e-9
"""Largest error of a weighted sum, relative to the sensor's largest reading; weights below it are rounding."""


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
