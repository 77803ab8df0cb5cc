"""Sensors that are weighted sums of a state, against weights worked out by hand."""

import mujoco
import numpy as np

from madoc.simulation.linear_sensors import linear_sensors

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
