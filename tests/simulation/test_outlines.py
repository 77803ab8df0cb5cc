"""Outlines of geoms worked by hand."""

import mujoco
import numpy as np

from madoc.simulation.outlines import outlines

MODEL = """
<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
  <body pos="0 0 1"><joint type="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.1" mass="1"/>
    <geom type="box" pos="0 0 -1" size="0.1 0.2 0.5" mass="1"/>
  </body></worldbody></mujoco>
"""


def test_geoms_become_segments_where_they_are():
    model = mujoco.MjModel.from_xml_string(MODEL)
    ends, radius = outlines(model, np.array([[0.0, 0.0], [np.pi / 2, 0.0]]))
    np.testing.assert_allclose(radius, [0.1, 0.15])
    hanging, level = ends[:, 0]
    np.testing.assert_allclose(sorted(hanging[:, 2]), [0.5, 1.0], atol=1e-12)
    np.testing.assert_allclose(level[:, 2], [1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(sorted(level[:, 0]), [-0.5, 0.0], atol=1e-12)
    # Half the longest side, less the rounding at its ends.
    np.testing.assert_allclose(sorted(ends[0, 1, :, 2]), [-0.35, 0.35], atol=1e-12)


def test_a_state_that_is_unknown_has_no_outline():
    ends, _ = outlines(mujoco.MjModel.from_xml_string(MODEL), np.array([[0.0], [np.nan]]))
    assert np.isfinite(ends[0]).all() and np.isnan(ends[1]).all()
