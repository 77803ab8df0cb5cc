"""A pendulum of hardware, so to speak, whose friction, drag or timing the model of its spec lacks."""

from pathlib import Path

import numpy as np

from madoc import robots, simulation
from madoc.data import logs

MODEL = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="{damping}{drag}" frictionloss="{friction}"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="hinge" joint="hinge"/></actuator>
</mujoco>
"""
SPEC = """
madoc: 1
name: pendulum
model: model.xml
control_step: 0.02
signals:
  - {name: angle, reads: position(hinge)}
  - {name: speed, reads: velocity(hinge)}
actions:
  - {name: torque, actuator: hinge, low: -1, high: 1}
parameters:
  - {field: dof_damping, element: hinge, low: 0, high: 0.5}
"""
NOISE = 0.002


def plant(
    folder: Path,
    *,
    friction: float = 0.0,
    drag: float = 0.0,
    late: int = 0,
    damping: float = 0.1,
    filtered: float = 0.0,
):
    """A log of the pendulum with a term that the model of its spec lacks, and what the tests need of it.

    Its damping is 0.1 N·m·s/rad in the first half of the log, and `damping` in the second. Its speed is logged behind a
    filter that mixes this share of the row before with each row.
    """
    folder.mkdir(exist_ok=True)
    (folder / "real.xml").write_text(MODEL.format(damping=0.1, friction=friction, drag=f" {drag} 0" if drag else ""))
    (folder / "real.yaml").write_text(SPEC.replace("model.xml", "real.xml"))
    (folder / "model.xml").write_text(MODEL.format(damping=0.1, friction=0, drag=""))
    (folder / "pendulum.yaml").write_text(SPEC)
    real = simulation.make(robots.load(folder / "real.yaml").task)
    systems, random = [real.bind(np.array([[value]])) for value in (0.1, damping)], np.random.default_rng(0)
    torque = np.repeat(random.uniform(-1, 1, 320), 5)
    state, angles = real.initial_state[None, None], []
    for row in range(len(torque)):
        system = systems[2 * row // len(torque)]
        angles.append(np.asarray(system.observe(state))[0, 0])
        state = system.step(state, torque[None, None, min(max(0, row - late), len(torque) - 1)][..., None])
    motion = np.array(angles)
    motion[1:, 1] += filtered * (motion[:-1, 1] - motion[1:, 1])
    seen = motion + NOISE * random.standard_normal((len(torque), 2))
    columns = np.column_stack([0.02 * np.arange(len(torque)), seen, torque])
    np.savetxt(folder / "log.csv", columns, "%.9g", ",", header="time,angle,speed,torque", comments="")
    robot = robots.load(folder / "pendulum.yaml")
    return logs.read([folder / "log.csv"], robot), simulation.make(robot.task)
