"""A process that draws what `pictures.py` asks for: it imports MuJoCo and NumPy alone, and may die of OpenGL."""

import sys
import time
from pathlib import Path

import mujoco
import numpy as np

PAPER, GHOST = (1.0, 1.0, 1.0, 1.0), (0.05, 0.6, 0.4, 0.4)
"""Colours of what is behind a robot, and of a robot that is seen through."""
ELEVATION = -8.0
"""Angle of view above the horizontal, deg."""


def main(folder: Path, panel: int, seconds: float) -> None:
    """Draw a panel of `asked.npz` of `model.mjb` into `panel_N.npy`, in about so many seconds at most."""
    model = mujoco.MjModel.from_binary_path(str(folder / "model.mjb"))
    with np.load(folder / "asked.npz", allow_pickle=False) as file:
        asked = dict(file)
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.4, 0.5
    width, height = asked["size"].tolist()
    # Edges are smooth as pictures are drawn at twice their size; samples take five times as long without a GPU.
    model.vis.global_.offwidth, model.vis.global_.offheight = 2 * width, 2 * height
    model.vis.quality.offsamples, model.vis.quality.shadowsize = 0, 1024
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation, camera.distance = float(asked["azimuth"]), ELEVATION, float(asked["distance"])
    data, beside = mujoco.MjData(model), mujoco.MjData(model)
    states, centres = asked["states"][panel], asked["centre"][panel]
    drawn, every = np.zeros((len(states), height, width, 3), dtype=np.uint8), 1
    with mujoco.Renderer(model, 2 * height, 2 * width, max_geom=2 * model.ngeom + 100) as renderer:
        for frame, (state, ghost) in enumerate(zip(states, asked["ghost"], strict=True)):
            if frame % every:
                drawn[frame] = drawn[frame - 1]
                continue
            began, camera.lookat[:] = time.monotonic(), centres[frame]
            _pose(model, data, state)
            renderer.update_scene(data, camera)
            if not np.isfinite(state[: model.nq]).all():  # a simulation that has failed is nowhere
                for index in range(renderer.scene.ngeom):
                    renderer.scene.geoms[index].rgba[3] = 0.0
            if np.isfinite(ghost[: model.nq]).all():
                _pose(model, beside, ghost)
                _add_ghost(model, beside, renderer.scene)
            _add_paper(camera, renderer.scene)
            drawn[frame] = renderer.render().reshape(height, 2, width, 2, 3).mean((1, 3))
            if frame == 1:  # the first loads the model's meshes
                every = int(np.ceil((time.monotonic() - began) * len(states) / seconds))
    np.save(folder / f"panel_{panel}.npy", drawn)


def _pose(model: mujoco.MjModel, data: mujoco.MjData, state: np.ndarray) -> None:
    """Put a robot into a state, if it is one."""
    if np.isfinite(state[: model.nq]).all():
        data.qpos[:] = state[: model.nq]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)


def _add_ghost(model: mujoco.MjModel, data: mujoco.MjData, scene: mujoco.MjvScene) -> None:
    """Add a second robot to a scene, to be seen through."""
    before, moving = scene.ngeom, int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
    mujoco.mjv_addGeoms(model, data, mujoco.MjvOption(), mujoco.MjvPerturb(), moving, scene)
    for index in range(before, scene.ngeom):
        geom = scene.geoms[index]
        geom.rgba[:], geom.matid, geom.reflectance = GHOST, -1, 0.0


def _add_paper(camera: mujoco.MjvCamera, scene: mujoco.MjvScene) -> None:
    """Add a sheet far behind the robot, as what is behind it would be black or a sky of the model."""
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    across = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    axes = np.stack([across, np.cross(away, across), -away], axis=1)
    far, geom = 4.0 * camera.distance, scene.geoms[scene.ngeom]
    sides, centre = np.array([10.0 * far, 10.0 * far, 0.01]), camera.lookat + far * away
    mujoco.mjv_initGeom(
        geom, mujoco.mjtGeom.mjGEOM_BOX, sides, centre, axes.flatten(), np.array(PAPER, dtype=np.float32)
    )
    geom.emission, geom.category = 1.0, int(mujoco.mjtCatBit.mjCAT_DECOR)
    scene.ngeom += 1


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))
