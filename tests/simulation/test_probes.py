"""Contacts have names, sensors of motion need no contacts, and which sensors are sums of the state."""

import mujoco
import numpy as np
import pytest

from madoc.simulation.probes import linear_sensors, sensing_motion, touching_geoms

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


TRUNK = """<mujoco><worldbody>
  <body><freejoint/><geom size="0.1"/>
    <site name="imu" pos="0.1 0 0" quat="0 0 0 1"/>
    <body pos="0 0 -0.1"><joint name="hip" axis="0 1 0"/><geom size="0.05" pos="0 0 -0.1"/>
      <site name="foot" pos="0 0 -0.2"/></body>
  </body></worldbody>
  <sensor>
    <jointpos name="hip" joint="hip"/><gyro name="gyro" site="imu"/>
    <framequat name="attitude" objtype="site" objname="imu"/>
    <velocimeter name="speed" site="imu"/><gyro name="of foot" site="foot"/><accelerometer name="push" site="imu"/>
  </sensor></mujoco>"""


def test_encoders_and_what_is_fixed_to_a_free_body_are_sums():
    model = mujoco.MjModel.from_xml_string(TRUNK)
    found = linear_sensors(model)
    assert sorted(found) == [model.sensor(name).adr[0] for name in ("hip", "gyro", "attitude")]
    (hip,), gyro, attitude = (found[int(model.sensor(name).adr[0])] for name in ("hip", "gyro", "attitude"))
    np.testing.assert_allclose(hip, np.eye(15)[7], atol=1e-12)
    # The site is turned by 180° about z: its x and y axes are the body's, reversed.
    np.testing.assert_allclose(gyro, np.diag([-1.0, -1.0, 1.0]) @ np.eye(15)[11:14], atol=1e-9)
    # (w, x, y, z) times the site's own (0, 0, 0, 1) is (-z, y, -x, w).
    w, x, y, z = np.eye(15)[3:7]
    np.testing.assert_allclose(attitude, [-z, y, -x, w], atol=1e-9)
