"""A model's geoms as solids, and where they are in each state, for viewers that draw them without MuJoCo."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int

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
