"""A process that draws what `pictures.py` asks for: it imports MuJoCo and NumPy alone, and may die of OpenGL."""

import sys
from pathlib import Path

import mujoco
import numpy as np


def main(folder: Path) -> None:
    """Draw `asked.npz` of `model.mjb` into `pictures.npy`."""
    model = mujoco.MjModel.from_binary_path(str(folder / "model.mjb"))
    with np.load(folder / "asked.npz", allow_pickle=False) as file:
        asked = dict(file)
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.4, 0.5
    width, height = asked["size"].tolist()
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    camera, data, frames = mujoco.MjvCamera(), mujoco.MjData(model), []
    camera.azimuth, camera.elevation, camera.distance = float(asked["azimuth"]), -6.0, float(asked["distance"])
    with mujoco.Renderer(model, height, width) as renderer:
        for state, centre in zip(asked["states"], asked["centre"], strict=True):
            data.qpos[:] = state[: model.nq]
            mujoco.mj_forward(model, data)
            camera.lookat[:] = centre
            renderer.update_scene(data, camera)
            colour = renderer.render()
            renderer.enable_segmentation_rendering()
            seen = renderer.render()[..., :1] >= 0
            renderer.disable_segmentation_rendering()
            frames.append(np.concatenate([colour, 255 * seen.astype(np.uint8)], axis=-1))
    drawn = np.stack(frames)
    if not drawn[..., :3][drawn[..., 3] > 0].any():
        raise SystemExit("all that was drawn is black")
    np.save(folder / "pictures.npy", drawn)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
