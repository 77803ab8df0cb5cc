"""Pictures by MuJoCo's renderer where OpenGL is to be had, none where it is broken, and the camera worked by hand."""

import ctypes.util

import mujoco
import numpy as np
import pytest

from madoc.simulation import pictures as drawing
from madoc.simulation.pictures import LIBRARIES, Camera, pictures, side_camera

MODEL = """
<mujoco><worldbody><body name="rod" pos="0 0 1"><joint type="hinge" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.05" rgba="1 0 0 1"/></body></worldbody></mujoco>
"""

CAMERA = Camera(np.tile([0.0, 0.0, 0.75], (2, 1)), 90.0, 1.5)


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(MODEL)


def test_a_rod_that_hangs_and_one_that_lies(model, monkeypatch):
    monkeypatch.delenv("MUJOCO_GL")
    if not any(map(ctypes.util.find_library, LIBRARIES.values())):
        pytest.skip("there is no OpenGL without a screen")
    drawn = pictures(model, np.array([[0.0, 0.0], [np.pi / 2, 0.0]]), CAMERA, width=80, height=60)
    if drawn is None:
        pytest.skip("OpenGL is broken here")
    assert drawn.shape == (2, 60, 80, 4)
    for (columns, rows), picture in zip(((True, False), (False, True)), drawn, strict=True):
        seen = np.argwhere(picture[..., 3])
        tall, wide = np.ptp(seen, axis=0)
        assert (tall > 3 * wide, wide > 3 * tall) == (columns, rows)
        assert (picture[picture[..., 3] > 0][:, 0].mean() > 50) & (picture[..., 1].max() < 100)  # red, not white


@pytest.mark.parametrize("process", ["import os; os.abort()", "import sys; sys.exit(1)", "import time; time.sleep(60)"])
def test_a_process_that_dies_of_opengl_leaves_no_pictures(process, model, tmp_path, monkeypatch):
    script = tmp_path / "render_process.py"
    script.write_text(process)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(drawing, "TIMEOUT", 0.5)
    monkeypatch.setattr(drawing, "__file__", str(tmp_path / "pictures.py"))
    assert pictures(model, np.zeros((2, 2)), CAMERA, width=8, height=8) is None


def test_who_wants_no_opengl_gets_none(model, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    assert pictures(model, np.zeros((2, 2)), CAMERA, width=8, height=8) is None


def test_the_camera_sees_all_from_the_side_that_moves():
    ends = np.zeros((2, 1, 2, 3))
    ends[1, 0, 1] = [0.5, 0.2, 1.0]
    camera, ratio = side_camera(ends, np.array([0.1]), 90.0, 2.0)
    np.testing.assert_allclose(camera.centre, np.tile([0.25, 0.1, 0.5], (2, 1)))
    # 0.7 m wide, 1.2 m high, and 0.4 m deep; at 90 degrees the distance is half of what has to be seen.
    assert (camera.azimuth, ratio) == (90.0, pytest.approx(0.35 / 0.6))
    assert camera.distance == pytest.approx(1.05 * (0.6 + 0.2))
    camera, _ = side_camera(ends[..., [1, 0, 2]], np.array([0.1]), 90.0, 2.0)
    assert camera.azimuth == 180.0
    far = ends + np.array([0.0, 5.0])[:, None, None, None] * np.array([1.0, 0.0, 0.0])
    camera, _ = side_camera(far, np.array([0.1]), 90.0, 2.0)
    np.testing.assert_allclose(camera.centre[:, 0], [0.0, 5.25])
