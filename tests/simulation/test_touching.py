"""Which geoms touch others: a ball that falls on a plane, and one that hangs above it."""

import mujoco
import numpy as np

from madoc.simulation.touching import touching_geoms

MODEL = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="1 1 1"/>
  <body pos="0 0 1"><joint type="slide" axis="0 0 1"/><geom {name} size="0.1"/></body>
  <body pos="0.5 0 1"><joint type="slide" axis="0 0 1"/><geom name="high" size="0.1"/></body>
</worldbody></mujoco>
"""


def test_what_moves_stands_for_a_contact_and_what_has_a_name_where_that_has_none():
    states = np.array([[0.0, 0.0, 0.0, 0.0], [-0.95, 0.0, 0.0, 0.0]])
    named = mujoco.MjModel.from_xml_string(MODEL.format(name='name="low"'))
    assert touching_geoms(named, states) == ("low",)
    assert touching_geoms(named, states[:1]) == ()
    assert touching_geoms(mujoco.MjModel.from_xml_string(MODEL.format(name="")), states) == ("floor",)
