"""A model's geoms in each state, for those who draw without MuJoCo: as thick segments, or as solids for viewers."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int

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


_KINDS = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "ellipsoid",
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): "ellipsoid",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
    int(mujoco.mjtGeom.mjGEOM_MESH): "mesh",
}
"""What a geom is; planes and terrain are ground, and others are not drawn."""
_SHOWN = 3
"""Groups of geoms that MuJoCo's own viewer shows, from 0; the others are for collisions, as a rule."""


@dataclass(frozen=True)
class Solid:
    """A geom in its own frame.

    Attributes:
        name: Its name, or else that of its body and its number.
        geom: Its index in the model.
        kind: `ellipsoid`, `capsule`, `cylinder`, `box` or `mesh`.
        size: Half of its sides along x, y and z, m; of a capsule or cylinder, radius, radius and half of its length.
        colour: RGBA, in [0, 1].
        vertices: Of a mesh, m.
        faces: Of a mesh, the vertices of each triangle.
    """

    name: str
    geom: int
    kind: str
    size: Float[np.ndarray, " xyz"]
    colour: Float[np.ndarray, " rgba"]
    vertices: Float[np.ndarray, "vertices xyz"]
    faces: Int[np.ndarray, "faces corners"]


def solids(model: mujoco.MjModel) -> tuple[Solid, ...]:
    """The geoms that a viewer shows."""
    shown = [geom for geom in range(model.ngeom) if model.geom_group[geom] < _SHOWN]
    return tuple(_solid(model, geom) for geom in shown if int(model.geom_type[geom]) in _KINDS)


def placed(
    model: mujoco.MjModel, of: tuple[Solid, ...], positions: Float[np.ndarray, "frames qpos"]
) -> tuple[Float[np.ndarray, "frames solids xyz"], Float[np.ndarray, "frames solids 3 3"]]:
    """Where the solids are in the world, m, and how they are turned; NaN where a position is."""
    data, geoms = mujoco.MjData(model), [solid.geom for solid in of]
    places, turns = (np.full((len(positions), len(of), *size), np.nan) for size in ((3,), (3, 3)))
    for frame in np.flatnonzero(np.isfinite(positions).all(1)):
        data.qpos[:] = positions[frame]
        mujoco.mj_kinematics(model, data)
        places[frame], turns[frame] = data.geom_xpos[geoms], data.geom_xmat[geoms].reshape(-1, 3, 3)
    return places, turns


def _solid(model: mujoco.MjModel, geom: int) -> Solid:
    kind, size = _KINDS[int(model.geom_type[geom])], model.geom_size[geom]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
        size = np.repeat(size[0], 3)
    elif kind in ("capsule", "cylinder"):
        size = size[[0, 0, 1]]
    vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)
    if kind == "mesh":
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        vertices = model.mesh_vert[first : first + count].astype(np.float64)
        first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        faces = model.mesh_face[first : first + count]
    material = model.geom_matid[geom]
    colour = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    body = model.body(model.geom_bodyid[geom]).name or f"body_{model.geom_bodyid[geom]}"
    name = model.geom(geom).name or f"{body}_{geom}"
    return Solid(name, geom, kind, np.array(size, float), colour.astype(np.float64), vertices, np.array(faces))
