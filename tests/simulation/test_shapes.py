"""Geoms as segments and as solids: where they are, and what has no place."""

import mujoco
import numpy as np

from madoc.simulation.shapes import outlines, placed, solids

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
