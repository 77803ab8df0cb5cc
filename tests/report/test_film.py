"""Outlines of geoms worked by hand, and strips of frames."""

import mujoco
import numpy as np

from madoc.report.film import read_film, strip
from madoc.simulation.outlines import outlines
from robots import ARM

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


def test_a_strip_has_a_frame_for_each_moment_until_the_episode_ends(tmp_path):
    ends, radius = outlines(mujoco.MjModel.from_xml_string(ARM), np.zeros((3, 4)))
    films = np.stack([ends, np.where(np.arange(3)[:, None, None, None] < 2, ends, np.nan)])
    names, time = np.array(["calibrated", "truth"]), np.array([0.0, 0.5, 1.0])
    np.savez(tmp_path / "film.npz", names=names, time=time, ends=films, radius=radius)
    film = read_film(tmp_path)
    geoms = len(radius)
    drawn = strip(film, 0, beside=1)
    assert (drawn.count('class="body"'), drawn.count('class="ghost"')) == (3 * geoms, 2 * geoms)
    assert strip(film, 1).count('class="body"') == 2 * geoms
    assert "0.5 s" in drawn
    assert read_film(tmp_path / "elsewhere") is None
