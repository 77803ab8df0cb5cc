"""Pictures by MuJoCo's renderer where OpenGL is to be had, else outlines; the camera, segments and solids by hand."""

import ctypes.util
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from madoc.simulation import pictures as drawing
from madoc.simulation.pictures import LIBRARIES, Camera, outlines, pictures, placed, side_camera, solids

MODEL = """
<mujoco><worldbody><body name="rod" pos="0 0 1"><joint type="hinge" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.05" rgba="1 0 0 1"/></body></worldbody></mujoco>
"""

CAMERA = Camera(np.tile([0.0, 0.0, 0.75], (1, 2, 1)), 90.0, 1.5)
HANGS, LIES, GONE = [0.0, 0.0], [np.pi / 2, 0.0], [np.nan, np.nan]


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(MODEL)


@pytest.fixture(params=["MuJoCo", "outlines"])
def way(request, monkeypatch):
    """How pictures are drawn."""
    monkeypatch.setenv("MUJOCO_GL", "disable")
    if request.param == "MuJoCo":
        monkeypatch.delenv("MUJOCO_GL")
        if not any(map(ctypes.util.find_library, LIBRARIES.values())):
            pytest.skip("there is no OpenGL without a screen")
    return request.param


def seen(picture):
    """Whether there is something in each pixel, and its mean colour."""
    there = (picture < 225).any(-1)
    return there, picture[there].mean(0) if there.any() else None


def is_tall(there):
    """Whether what is seen is higher than wide, or else wider than high."""
    tall, wide = np.ptp(np.argwhere(there), axis=0)
    assert max(tall, wide) > 3 * min(tall, wide)
    return tall > wide


def test_a_rod_that_hangs_and_one_that_lies(model, way):
    (drawn,) = pictures(model, np.array([[HANGS, LIES]]), CAMERA, width=80, height=60)
    assert drawn.shape == (2, 60, 80, 3)
    assert [is_tall(seen(picture)[0]) for picture in drawn] == [True, False]
    red, green, blue = seen(drawn[0])[1]
    assert (red > 2 * max(green, blue)) if way == "MuJoCo" else (blue > red)


def test_panels_stand_in_their_order(model, way):
    two = replace(CAMERA, centre=np.repeat(CAMERA.centre[:, :1], 2, axis=0))
    drawn = pictures(model, np.array([[HANGS], [LIES]]), two, width=80, height=60)
    assert [is_tall(seen(panel[0])[0]) for panel in drawn] == [True, False]


def test_a_ghost_shines_where_it_is_and_a_failed_simulation_is_nowhere(model, way):
    (drawn,) = pictures(model, np.array([[HANGS, GONE]]), CAMERA, ghost=np.array([GONE, LIES]), width=80, height=60)
    assert [is_tall(seen(picture)[0]) for picture in drawn] == [True, False]
    red, green, blue = seen(drawn[1])[1]
    assert green > blue > red


@pytest.mark.parametrize("process", ["import os; os.abort()", "import sys; sys.exit(1)", "import time; time.sleep(60)"])
def test_a_process_that_dies_of_opengl_leaves_outlines(process, model, tmp_path, monkeypatch):
    script = tmp_path / "render_process.py"
    script.write_text(process)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(drawing, "TIMEOUT", 0.5)
    monkeypatch.setattr(drawing, "__file__", str(tmp_path / "pictures.py"))
    asked = model, np.array([[HANGS, LIES]]), CAMERA
    drawn = pictures(*asked, width=8, height=8)
    monkeypatch.setenv("MUJOCO_GL", "disable")
    np.testing.assert_array_equal(drawn, pictures(*asked, width=8, height=8))


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


SEGMENTS = """
<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
  <body pos="0 0 1"><joint type="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.1" mass="1"/>
    <geom type="box" pos="0 0 -1" size="0.1 0.2 0.5" mass="1"/>
  </body></worldbody></mujoco>
"""


def test_geoms_become_segments_where_they_are():
    model = mujoco.MjModel.from_xml_string(SEGMENTS)
    ends, radius = outlines(model, np.array([[0.0, 0.0], [np.pi / 2, 0.0]]))
    np.testing.assert_allclose(radius, [0.1, 0.15])
    hanging, level = ends[:, 0]
    np.testing.assert_allclose(sorted(hanging[:, 2]), [0.5, 1.0], atol=1e-12)
    np.testing.assert_allclose(level[:, 2], [1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(sorted(level[:, 0]), [-0.5, 0.0], atol=1e-12)
    # Half the longest side, less the rounding at its ends.
    np.testing.assert_allclose(sorted(ends[0, 1, :, 2]), [-0.35, 0.35], atol=1e-12)


def test_a_state_that_is_unknown_has_no_outline():
    ends, _ = outlines(mujoco.MjModel.from_xml_string(SEGMENTS), np.array([[0.0], [np.nan]]))
    assert np.isfinite(ends[0]).all() and np.isnan(ends[1]).all()


SOLIDS = """
<mujoco>
  <asset>
    <material name="blue" rgba="0 0 1 1"/>
    <mesh name="corner" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/>
  </asset>
  <worldbody><geom type="plane" size="1 1 .1"/>
    <body name="arm" pos="0 0 1"><joint type="hinge" axis="0 1 0"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.1" rgba="1 0 0 0.5"/>
      <geom type="sphere" pos="0 0 -1" size="0.2" material="blue"/>
      <geom type="mesh" mesh="corner"/>
      <geom type="box" size="0.1 0.2 0.3" group="3"/>
    </body>
  </worldbody>
</mujoco>
"""


def test_shown_geoms_are_solids_in_their_own_frames():
    rod, ball, corner = solids(mujoco.MjModel.from_xml_string(SOLIDS))  # neither the plane nor a geom of group 3
    assert (rod.name, rod.kind, rod.size.tolist(), rod.colour.tolist()) == (
        "rod",
        "capsule",
        [0.1, 0.1, 0.25],
        [1.0, 0.0, 0.0, 0.5],
    )
    assert (ball.name, ball.kind, ball.size.tolist()) == ("arm_2", "ellipsoid", [0.2, 0.2, 0.2])
    assert ball.colour.tolist() == [0.0, 0.0, 1.0, 1.0]
    assert (corner.kind, corner.vertices.shape, corner.faces.shape) == ("mesh", (4, 3), (4, 3))
    edges = np.linalg.norm(corner.vertices[:, None] - corner.vertices, axis=-1)
    assert np.allclose(sorted(edges[np.triu_indices(4, 1)]), [1.0] * 3 + [2.0**0.5] * 3)


def test_solids_turn_with_their_body_and_are_nowhere_in_an_unknown_state():
    model = mujoco.MjModel.from_xml_string(SOLIDS)
    places, turns = placed(model, solids(model), np.array([[0.0], [np.pi / 2], [np.nan]]))
    np.testing.assert_allclose(places[:2, 1], [[0.0, 0.0, 0.0], [-1.0, 0.0, 1.0]], atol=1e-12)  # the ball, 1 m below
    np.testing.assert_allclose(turns[1, 1] @ [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], atol=1e-12)
    assert np.isnan(places[2]).all() and np.isnan(turns[2]).all()
