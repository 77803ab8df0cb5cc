"""Which geoms touch others: a ball that falls on a plane, and one that hangs above it."""

import mujoco
import numpy as np
import pytest

from madoc.simulation.touching import sensing_motion, touching_geoms

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


SENSING = """
<mujoco><worldbody>
  <geom type="plane" size="1 1 1"/>
  <body pos="0 0 0.05"><freejoint/><geom size="0.1"/><site name="imu" pos="0.02 0 0.03"/>
    <body><joint name="arm" range="-1 -0.5" limited="true"/><geom size="0.05" pos="0 0 0.2"/></body></body>
</worldbody><sensor><gyro site="imu"/><framequat objtype="site" objname="imu"/>{more}</sensor></mujoco>
"""


@pytest.mark.parametrize(
    ("more", "left_out"),
    [("", True), ('<touch site="imu"/>', False), ('<jointlimitpos joint="arm"/>', False), ("<clock/>", True)],
)
def test_sensors_of_motion_read_the_same_without_contacts_and_others_keep_them(more, left_out):
    model = mujoco.MjModel.from_xml_string(SENSING.format(more=more))

    def read():
        data = mujoco.MjData(model)
        data.qvel[:] = np.linspace(-1.0, 1.0, model.nv)
        mujoco.mj_step(model, data)
        return data.sensordata.copy(), data.ncon

    whole, touching = read()
    before = model.opt.disableflags
    with sensing_motion([model]):
        np.testing.assert_array_equal(read()[0], whole)
        assert read()[1] == (0 if left_out else touching) and touching > 0
    assert model.opt.disableflags == before
