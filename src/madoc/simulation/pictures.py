"""Pictures of a model by MuJoCo's renderer, where OpenGL is to be had without a screen; else outlines drawn by Pillow.

A broken OpenGL library ends its process, so `render_process.py` draws in one of its own.
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
from jaxtyping import Float, UInt8

from madoc.runs.machine import usable_cores
from madoc.simulation.shapes import outlines

LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
"""The ways to OpenGL without a screen, as MuJoCo's `MUJOCO_GL` names them, and the library that each needs."""
TIMEOUT = 30.0
"""Longest time in s that drawing may take with each of them, after which it is stopped."""
DRAWING = 8.0
"""Time in s that drawing may take; where it takes longer, some pictures stand for those after them."""
PAPER, BODY, GHOST = (255, 255, 255), ((31, 111, 214), 230), ((13, 153, 102), 100)
"""Colours of outlines: what is behind them, and their own with an opacity of 255."""


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
