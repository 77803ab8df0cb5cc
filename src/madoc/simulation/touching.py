"""Which geoms a robot touches others with, and steps without contacts, where sensors do not show them."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import mujoco
import numpy as np
from jaxtyping import Float


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


_OF_CONSTRAINTS = tuple(
    int(getattr(mujoco.mjtSensor, f"mjSENS_{name}"))
    for name in ("JOINTLIMITPOS", "JOINTLIMITVEL", "TENDONLIMITPOS", "TENDONLIMITVEL", "USER", "PLUGIN")
)
"""Sensors that may show constraints though they belong to positions or velocities."""


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
