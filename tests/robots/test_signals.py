"""Signals of a spec: what they read, what sensors feel, and the states that they tell."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from madoc import robots
from madoc.errors import MadocError
from madoc.simulation.cpu import CpuSimulator
from own_robots import ARM_SPEC, CART_SPEC, task_of, write_robot


def test_a_bias_is_seen_and_taken_off_the_start(tmp_path):
    bias = "  - {field: signal_bias, element: place, low: -0.1, high: 0.1}\n"
    task = task_of(tmp_path, CART_SPEC.replace("position(rail)", "2 * position(rail) + 1") + bias)
    assert task.parameters.parameters[1].unit == "1"
    system = CpuSimulator(task, threads=1).bind(np.array([[1.0, 0.0], [1.0, 0.06]]))
    state = np.full((2, 1, 2), [0.5, 3.0])
    np.testing.assert_allclose(system.observe(state)[:, 0], [[2.0, 3.0], [2.06, 3.0]])
    # An observation of 2.06 by a sensor that reads 0.06 too much is a place of 0.5.
    rebuilt = task.state_from_observation(np.full((2, 1, 2), [2.06, 3.0]))
    np.testing.assert_allclose(system.unbiased(rebuilt)[:, 0], [[0.53, 3.0], [0.5, 3.0]])


SENSED = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body name="cart"><joint name="rail" type="slide" axis="1 0 0"/><geom type="box" size=".1 .1 .1" mass="2"/>
      <site name="front" pos="0.3 0 0"/></body>
  </worldbody>
  <sensor><framepos name="front" objtype="site" objname="front"/><accelerometer name="shake" site="front"/></sensor>
</mujoco>
"""


def test_sensors_are_read_in_a_forward_pass_of_each_system(tmp_path):
    spec = CART_SPEC.replace("place, reads: position(rail)", 'place, reads: "sensor(front)[0] * 1000", unit: mm')
    task = task_of(tmp_path, spec, cart=SENSED)
    assert task.pending == 0
    assert task.state_from_observation is None
    system = CpuSimulator(task, threads=1).bind(np.array([[1.0], [2.0]]))
    state = np.tile([0.2, -1.0], (2, 12, 1))
    state[1, 3] = np.nan
    seen = system.observe(state)
    np.testing.assert_allclose(seen[0], np.tile([500.0, -1.0], (12, 1)), rtol=1e-12)
    assert np.isnan(seen[1, 3]).all()
    assert np.isfinite(seen[1, 4:]).all()
    with pytest.raises(MadocError, match="only a bound system can make it"):
        task.observe(state)


def test_a_sensor_of_acceleration_feels_the_last_action(tmp_path):
    spec = CART_SPEC.replace("velocity(rail)", '"sensor(shake)[0]"')
    task = task_of(tmp_path, spec, cart=SENSED)
    assert task.pending == 1
    system = CpuSimulator(task, threads=1).bind(np.array([[0.5], [2.0]]))
    seen = system.observe(np.full((2, 1, 3), [0.0, 0.0, 0.4]))  # 4 N
    np.testing.assert_allclose(seen[:, 0, 1], [8.0, 2.0], rtol=1e-12)


def test_a_sensor_feels_the_action_that_has_taken_effect(tmp_path):
    spec = CART_SPEC.replace("velocity(rail)", '"sensor(shake)[0]"') + "  - {field: action_delay, low: 0, high: 0.04}\n"
    simulator = CpuSimulator(task_of(tmp_path, spec, cart=SENSED), threads=1)
    assert simulator.task.pending == 3  # 0.04 s, and the physics step of 0.01 s in which that action still holds
    delays = (0.01, 0.03, 0.015, 0.035)
    system = simulator.bind(np.array([[1.0, delay] for delay in delays]))
    seen = system.observe(np.full((4, 1, 5), [0.0, 0.0, 0.4, -0.2, 0.6]))
    # Where actions change within the last physics step, it has half of each: (4 - 2) / 2 and (-2 + 6) / 2.
    np.testing.assert_allclose(seen[:, 0, 1], [4.0, -2.0, 1.0, 2.0], rtol=1e-12)


def test_a_state_needs_every_position_and_velocity(tmp_path):
    hidden = ARM_SPEC.replace("  - {name: elbow_speed, reads: velocity(elbow)}\n", "")
    robot = robots.load(write_robot(tmp_path, hidden))
    assert robot.task.state_from_observation is None
    assert robot.undetermined == ("no signal is the velocity of elbow",)
    bent = ARM_SPEC.replace("position(elbow)", "sin(position(elbow))")
    assert task_of(tmp_path, bent).state_from_observation is None


def test_sums_of_joints_are_taken_apart(tmp_path):
    # Encoders that see the forearm's angle in the world, and one that sees the shoulder twice.
    spec = ARM_SPEC.replace("reads: position(elbow)", "reads: position(shoulder) + position(elbow)")
    spec = spec.replace("reads: position(shoulder), unit: rad", "reads: 3 - 2 * position(shoulder)")
    task = task_of(tmp_path, spec)
    state = np.random.default_rng(0).normal(size=(5, 4))
    np.testing.assert_allclose(task.state_from_observation(task.observe(state)), state, atol=1e-12)
    np.testing.assert_allclose(jax.jit(task.observe)(jnp.asarray(state)), task.observe(state), rtol=1e-5)


def test_a_free_body_has_thirteen_values(tmp_path):
    model = """<mujoco><worldbody><body name="box" pos="0 0 1"><freejoint name="root"/>
      <geom type="box" size=".1 .1 .1" mass="1"/><body name="arm"><joint name="j"/><geom size=".05" mass=".1"/></body>
      </body></worldbody></mujoco>"""
    reads = [f"position(root)[{i}]" for i in range(7)] + ["position(j)"]
    reads += [f"velocity(root)[{i}]" for i in range(6)] + ["velocity(j)"]
    signals = "".join(f'  - {{name: s{i}, reads: "{text}"}}\n' for i, text in enumerate(reads))
    spec = (
        "madoc: 1\nname: box\nmodel: box.xml\ncontrol_step: 0.02\nsignals:\n" + signals + "actions:\n"
        "  - {name: t, joint: j, means: torque, low: -1, high: 1}\n"
        "parameters:\n  - {field: body_mass, element: box, low: 0.5, high: 2}\n"
    )
    task = task_of(tmp_path, spec, box=model)
    state = CpuSimulator(task, threads=1).initial_state
    np.testing.assert_array_equal(task.observe(state), state)
    np.testing.assert_array_equal(task.state_from_observation(state), state)


def test_what_signals_tell_of_a_state(tmp_path):
    # The elbow's encoder sees the sum of both angles; only the elbow's speed is measured, as twice itself plus 1.
    spec = ARM_SPEC.replace("reads: position(elbow)", "reads: position(shoulder) + position(elbow)")
    spec = spec.replace("  - {name: shoulder_speed, reads: velocity(shoulder)}\n", "")
    spec = spec.replace("reads: velocity(elbow)", "reads: 1 + 2 * velocity(elbow)")
    task = task_of(tmp_path, spec)
    assert task.state_from_observation is None
    state = np.random.default_rng(0).normal(size=(5, 4))
    expected = state.copy()
    expected[:, 2] = np.nan
    np.testing.assert_allclose(task.posture(task.observe(state)), expected, atol=1e-12)
    assert task_of(tmp_path, ARM_SPEC.replace("position(", "velocity(")).posture is None
