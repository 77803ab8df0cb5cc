"""Which geoms touch others: a ball that falls on a plane, and one that hangs above it."""

import mujoco
import numpy as np
import pytest

from madoc.simulation.touching import only_in_pairs, touching_geoms

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


LEG = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="1 1 1"/>
  <body name="shin" pos="0 0 1"><joint type="slide" axis="0 0 1"/><geom name="shin" {shin} size="0.1"/>
    <body name="foot" pos="0 0 -.3"><joint type="hinge"/><geom name="foot" {foot} size="0.1"/></body></body>
</worldbody><contact>{pairs}</contact></mujoco>
"""
NONE, SOLE = 'contype="0" conaffinity="0"', '<pair geom1="foot" geom2="floor"/>'


@pytest.mark.parametrize(
    ("shin", "foot", "pairs", "alone"),
    [
        (NONE, NONE, SOLE, ["floor", "foot"]),
        (NONE, "", SOLE, ["floor", "foot"]),
        ("", "", SOLE, ["foot"]),  # the shin, its parent, does not touch it, and touches the floor
        ("", "", "", []),
        (NONE, NONE, "", []),  # what touches nothing is found where a log shows no effect
        ("", NONE, SOLE + '<pair geom1="foot" geom2="shin"/>', ["foot"]),
    ],
)
def test_geoms_that_touch_others_by_pairs_alone(shin, foot, pairs, alone):
    model = mujoco.MjModel.from_xml_string(LEG.format(shin=shin, foot=foot, pairs=pairs))
    names = ("floor", "shin", "foot")
    assert [name for name in names if only_in_pairs(model, model.geom(name).id)] == alone
