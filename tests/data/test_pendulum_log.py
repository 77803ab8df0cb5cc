"""Measured rows of a real pendulum (torque_limited_simple_pendulum, DFKI RIC), where they are present."""

from pathlib import Path

import numpy as np
import pytest

from madoc import robots as own
from madoc import simulation
from madoc.data import logs
from madoc.diagnosis import check

DATA = Path(__file__).parents[3] / "shared" / "data" / "dfki_simple_pendulum"

MODEL = """
<mujoco>
  <option timestep="0.001" gravity="0 0 -9.81" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.1" frictionloss="0.1" armature="0.01"/>
      <inertial pos="0 0 -0.5" mass="0.6" diaginertia="0.001 0.001 0.001"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""

SPEC = """\
madoc: 1
name: pendulum
model: pendulum.xml
control_step: 0.01
signals:
  - {name: position, reads: position(hinge)}
  - {name: velocity, reads: velocity(hinge)}
actions:
  - {name: torque, actuator: motor, low: -20, high: 20, unit: N·m}
parameters:
  - {field: body_mass, element: rod, low: 0.3, high: 1.2}
  - {field: dof_armature, element: hinge, low: 0, high: 0.1}
  - {field: dof_damping, element: hinge, low: 0, high: 0.5}
  - {field: dof_frictionloss, element: hinge, low: 0, high: 0.5}
log: {resample: linear}
"""


def test_a_real_pendulum(tmp_path):
    if not DATA.is_dir():
        pytest.skip(f"{DATA} is not here")
    (tmp_path / "pendulum.xml").write_text(MODEL)
    (tmp_path / "pendulum.yaml").write_text(SPEC)
    robot = own.load(tmp_path / "pendulum.yaml")
    dataset = logs.read(DATA, robot)
    assert len(set(dataset.run_names)) == 7
    assert {finding.level for finding in dataset.findings} == {"note"}
    seconds = 0.01 * len(dataset)
    assert seconds == pytest.approx(140.0, abs=1.0)  # the files end at 4 to 40 s, 140 s together
    found = check(dataset, simulation.make(robot.task, threads=1), robot=robot)
    assert not found.fatal
    errors = found.explanation.errors[found.explanation.best]
    assert found.explanation.horizons == (2, 10, 40)
    assert (errors[-1] < 0.6).all()  # 0.4 s ahead
    assert np.isfinite(found.excitation.half_width).all()
    mass = found.excitation.half_width[0]
    assert 0.0 < mass < 0.1
