"""What a model looks like in a state: every geom as a thick segment, to draw it without OpenGL."""

import mujoco
import numpy as np
from jaxtyping import Float

_FLAT = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
"""Geoms that are ground, not robot."""
_LENGTHWISE = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))
"""Geoms whose radius and half-length are their first two sizes, along z."""


def outlines(
    model: mujoco.MjModel, states: Float[np.ndarray, "frames state"]
) -> tuple[Float[np.ndarray, "frames geoms ends xyz"], Float[np.ndarray, " geoms"]]:
    """The two ends of each geom in m, in world coordinates, and its radius in m; planes are left out, NaN stays NaN.

    A capsule is itself. A sphere's ends coincide. Of any other geom the longest side of its bounding box is the
    segment, and half the mean of the others its radius.
    """
    geoms = [geom for geom in range(model.ngeom) if model.geom_type[geom] not in _FLAT]
    shapes = [_segment(model, geom) for geom in geoms]
    data, frames = mujoco.MjData(model), []
    for state in states:
        known = np.isfinite(state[: model.nq]).all()
        data.qpos[:] = state[: model.nq] if known else model.qpos0
        mujoco.mj_kinematics(model, data)
        placed = zip(geoms, shapes, strict=True)
        at = [data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T for geom, (local, _) in placed]
        frames.append(at if known else [np.full((2, 3), np.nan)] * len(geoms))
    ends = np.array(frames, dtype=np.float64).reshape(len(states), len(geoms), 2, 3)
    return ends, np.array([radius for _, radius in shapes], dtype=np.float64)


def _segment(model: mujoco.MjModel, geom: int) -> tuple[Float[np.ndarray, "ends xyz"], float]:
    """The ends of a geom in its own frame, and its radius."""
    if model.geom_type[geom] in _LENGTHWISE:
        radius, half = model.geom_size[geom, :2]
        return np.array([[0.0, 0.0, -half], [0.0, 0.0, half]]), float(radius)
    centre, sides = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    longest = int(sides.argmax())
    radius = float(np.delete(sides, longest).mean())
    reach = np.eye(3)[longest] * max(0.0, float(sides[longest]) - radius)
    return np.array([centre - reach, centre + reach]), radius
