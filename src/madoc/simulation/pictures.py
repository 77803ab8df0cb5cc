"""Pictures of a model by MuJoCo's renderer, where OpenGL is to be had without a screen; else outlines drawn by Pillow.

A broken OpenGL library ends its process, so `render_process.py` draws in one of its own. Geoms are thick segments for
those outlines, and solids for viewers that draw without MuJoCo.
"""

import contextlib
import ctypes.util
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float, Int, UInt8

from madoc.runs.machine import usable_cores

_FLAT = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
"""Geoms that are ground, not robot."""
_LENGTHWISE = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))
"""Geoms whose radius and half-length are their first two sizes, along z."""

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
LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
"""The ways to OpenGL without a screen, as MuJoCo's `MUJOCO_GL` names them, and the library that each needs."""
TIMEOUT = 30.0
"""Longest time in s that drawing may take with each of them, after which it is stopped."""
DRAWING = 8.0
"""Time in s that drawing may take; where it takes longer, some pictures stand for those after them."""
PAPER, BODY, GHOST = (255, 255, 255), ((31, 111, 214), 230), ((13, 153, 102), 100)
"""Colours of outlines: what is behind them, and their own with an opacity of 255."""


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


@dataclass(frozen=True)
class Camera:
    """A camera that looks at a robot from the side, at a point of its own in each frame.

    Attributes:
        centre: The points, m; of several panels a row for each.
        azimuth: Direction of view about the vertical, deg: 90 has x to the right, 180 has y to the right.
        distance: From the camera to the point, m.
    """

    centre: Float[np.ndarray, "*panels frames xyz"]
    azimuth: float
    distance: float


def pictures(
    model: mujoco.MjModel,
    states: Float[np.ndarray, "panels frames state"],
    camera: Camera,
    *,
    ghost: Float[np.ndarray, "frames state"] | None = None,
    width: int,
    height: int,
) -> UInt8[np.ndarray, "panels frames height width 3"]:
    """What a camera sees of a model in each state, in RGB, and of a `ghost` of it in another state that shines through.

    Nothing is drawn of a state that is NaN. The way to OpenGL is that of the environment's `MUJOCO_GL` alone where that
    is set, so `MUJOCO_GL=disable` draws outlines.
    """
    beside = np.full(states.shape[1:], np.nan) if ghost is None else ghost
    # No room for its files, or no process: then outlines have to do, as that is no reason for a run to fail.
    with contextlib.suppress(OSError), tempfile.TemporaryDirectory(prefix="madoc-") as place:
        folder = Path(place)
        for library in _ways():
            if not (folder / "model.mjb").exists():
                mujoco.mj_saveModel(model, str(folder / "model.mjb"))
                asked = {"states": states, "ghost": beside, "size": np.array([width, height])} | vars(camera)
                np.savez(folder / "asked.npz", allow_pickle=False, **asked)
            if _draw(folder, library, len(states)):
                files = [folder / f"panel_{panel}.npy" for panel in range(len(states))]
                drawn = np.stack([np.load(file, allow_pickle=False) for file in files])
                if np.ptp(drawn):  # else OpenGL has drawn nothing
                    return drawn
    of_ghost = outlines(model, beside)[0]
    each = zip(states, camera.centre, strict=True)
    return np.stack([_sketches(model, *part, of_ghost, camera=camera, width=width, height=height) for part in each])


def _sketches(
    model: mujoco.MjModel,
    states: Float[np.ndarray, "frames state"],
    centre: Float[np.ndarray, "frames xyz"],
    ghost: Float[np.ndarray, "frames geoms ends xyz"],
    *,
    camera: Camera,
    width: int,
    height: int,
) -> UInt8[np.ndarray, "frames height width 3"]:
    """Outlines of each geom from the side, at twice the size and made smaller, so that edges are smooth."""
    from PIL import Image, ImageDraw

    ends, radius = outlines(model, states)
    scale = height / (camera.distance * np.tan(np.radians(float(model.vis.global_.fovy)) / 2.0))
    along, drawn = int(camera.azimuth > 135.0), []
    for point, *bodies in zip(centre, ends, ghost, strict=True):
        picture = Image.new("RGB", (2 * width, 2 * height), PAPER)
        for body, (colour, opacity) in zip(bodies, (BODY, GHOST), strict=True):
            shape = Image.new("L", picture.size)
            pen = ImageDraw.Draw(shape)
            flat = (body - point)[..., [along, 2]] * scale * (1.0, -1.0) + (width, height)
            for line, thick in zip(flat, (radius * scale).tolist(), strict=True):
                if np.isfinite(line).all():
                    pen.line([tuple(end) for end in line.tolist()], opacity, max(1, round(2.0 * thick)))
                    for x, y in line.tolist():
                        pen.ellipse((x - thick, y - thick, x + thick, y + thick), opacity)
            picture.paste(colour, mask=shape)
        drawn.append(np.asarray(picture.reduce(2)))
    return np.stack(drawn)


def side_camera(
    ends: Float[np.ndarray, "frames geoms ends xyz"], radius: Float[np.ndarray, " geoms"], fovy: float, most: float
) -> tuple[Camera, float]:
    """The camera from whose side all frames move most and fit, and the width of its picture by the height.

    `ends` and `radius` are the outlines of the frames, m, `fovy` is the vertical angle of view, deg, and `most` the
    largest ratio of width to height; the smallest is one by this.
    """
    low = (ends - radius[:, None, None]).min((1, 2))
    high = (ends + radius[:, None, None]).max((1, 2))
    along = int(np.ptp(ends[..., 1]) > np.ptp(ends[..., 0]))
    centre = np.tile((low.min(0) + high.max(0)) / 2, (len(ends), 1))
    middle = (low + high)[:, along] / 2
    if np.ptp(middle) > (high - low)[:, [along, 2]].sum(1).max():  # it travels: the camera goes with it
        centre[:, along] = middle
    reach = np.maximum(high - centre, centre - low).max(0)
    across, up, deep = reach[along], reach[2], reach[1 - along]
    ratio = float(np.clip(across / max(up, 1e-9), 1.0 / most, most))
    distance = deep + max(up, across / ratio) / np.tan(np.radians(fovy) / 2)
    return Camera(centre, 180.0 if along else 90.0, 1.05 * max(float(distance), 1e-3)), ratio


def _ways() -> list[str]:
    """The values of `MUJOCO_GL` to try, the fastest first."""
    asked = os.environ.get("MUJOCO_GL", "").lower()
    if asked:
        return [asked] if asked in LIBRARIES else []
    return [way for way, library in LIBRARIES.items() if ctypes.util.find_library(library)]


def _draw(folder: Path, way: str, panels: int) -> bool:
    """Let a process for each panel draw what the folder asks; whether all did."""
    words = [sys.executable, "-P", str(Path(__file__).with_name("render_process.py")), str(folder)]
    environment, turns = os.environ | {"MUJOCO_GL": way, "PYOPENGL_PLATFORM": way}, -(-panels // usable_cores())

    def drawn(panel: int) -> bool:
        with contextlib.suppress(subprocess.TimeoutExpired):
            asked, limit = [*words, str(panel), str(DRAWING / turns)], TIMEOUT / turns
            done = subprocess.run(
                asked, env=environment, timeout=limit, stdin=subprocess.DEVNULL, capture_output=True, check=False
            )
            return done.returncode == 0
        return False

    with ThreadPoolExecutor(usable_cores()) as pool:
        return all(pool.map(drawn, range(panels)))
