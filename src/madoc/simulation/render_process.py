"""A process that draws what `pictures.py` asks for: it imports MuJoCo and NumPy alone, and may die of OpenGL."""

import sys
from pathlib import Path

import mujoco
import numpy as np

PAPER, GHOST = (1.0, 1.0, 1.0, 1.0), (0.05, 0.6, 0.4, 0.4)
"""Colours of what is behind a robot, and of a robot that is seen through."""
ELEVATION = -8.0
"""Angle of view above the horizontal, deg."""


def main(folder: Path) -> None:
    """Draw `asked.npz` of `model.mjb` into `pictures.npy`."""
    model = mujoco.MjModel.from_binary_path(str(folder / "model.mjb"))
    with np.load(folder / "asked.npz", allow_pickle=False) as file:
        asked = dict(file)
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.4, 0.5
    width, height = asked["size"].tolist()
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation, camera.distance = float(asked["azimuth"]), ELEVATION, float(asked["distance"])
    data, beside, drawn = mujoco.MjData(model), mujoco.MjData(model), []
    with mujoco.Renderer(model, height, width, max_geom=2 * model.ngeom + 100) as renderer:
        for states, centres in zip(asked["states"], asked["centre"], strict=True):
            for state, ghost, centre in zip(states, asked["ghost"], centres, strict=True):
                camera.lookat[:] = centre
                _pose(model, data, state)
                renderer.update_scene(data, camera)
                own = 0 if np.isfinite(state[: model.nq]).all() else renderer.scene.ngeom
                for index in range(own):
                    renderer.scene.geoms[index].rgba[3] = 0.0  # a simulation that has failed is nowhere
                if np.isfinite(ghost[: model.nq]).all():
                    _pose(model, beside, ghost)
                    _add_ghost(model, beside, renderer.scene)
                _add_paper(camera, renderer.scene)
                drawn.append(renderer.render())
    if not np.ptp(drawn, axis=(0, 1, 2)).any():
        raise SystemExit("nothing was drawn")
    np.save(folder / "pictures.npy", np.reshape(drawn, (*asked["states"].shape[:2], height, width, 3)))


def _pose(model: mujoco.MjModel, data: mujoco.MjData, state: np.ndarray) -> None:
    """Put a robot into a state, if it is one."""
    if np.isfinite(state[: model.nq]).all():
        data.qpos[:] = state[: model.nq]
        mujoco.mj_forward(model, data)


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
    main(Path(sys.argv[1]))
