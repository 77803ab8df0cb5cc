"""Which geoms a robot touches others with."""

from collections.abc import Collection, Iterator
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


def only_in_pairs(model: mujoco.MjModel, geom: int) -> bool:
    """Whether a geom touches others by `<pair>` alone, whose friction and solref count there in place of its own.

    Bodies that an `<exclude>` keeps apart count as if they might touch.
    """
    ends = np.stack([model.pair_geom1, model.pair_geom2])
    own = ends[:, (ends == geom).any(0)]
    weld = model.body_weldid[model.geom_bodyid]
    parent = model.body_weldid[model.body_parentid[weld]]
    alike = (model.geom_contype & model.geom_conaffinity[geom]) | (model.geom_contype[geom] & model.geom_conaffinity)
    linked = (weld != 0) & (weld[geom] != 0) & ((parent == weld[geom]) | (weld == parent[geom]))
    linked &= not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    others = (alike != 0) & (weld != weld[geom]) & ~linked
    others[own] = False
    cloth = (model.flex_contype & model.geom_conaffinity[geom]) | (model.geom_contype[geom] & model.flex_conaffinity)
    return bool(own.size) and not others.any() and not cloth.any()


_OF_CONSTRAINTS = tuple(
    int(getattr(mujoco.mjtSensor, f"mjSENS_{name}"))
    for name in ("JOINTLIMITPOS", "JOINTLIMITVEL", "TENDONLIMITPOS", "TENDONLIMITVEL", "USER", "PLUGIN")
)
"""Sensors that may show constraints though they belong to positions or velocities."""


@contextmanager
def sensing_motion(models: Collection[mujoco.MjModel]) -> Iterator[None]:
    """Leave constraints out of steps that are for sensors alone, where these show positions and velocities.

    Contacts and limits are most of a step's work. Models with sensors of forces or accelerations stay as they are.
    """
    shown = [
        model
        for model in models
        if (model.sensor_needstage <= int(mujoco.mjtStage.mjSTAGE_VEL)).all()
        and not np.isin(model.sensor_type, _OF_CONSTRAINTS).any()
    ]
    before = [model.opt.disableflags for model in shown]
    for model in shown:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    try:
        yield
    finally:
        for model, flags in zip(shown, before, strict=True):
            model.opt.disableflags = flags
