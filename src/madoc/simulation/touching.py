"""Which geoms a robot touches others with."""

from collections.abc import Iterator

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
