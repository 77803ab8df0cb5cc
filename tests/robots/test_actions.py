"""Actions of a spec: servos, limits and units, by hand."""

import numpy as np
import pytest

from madoc import robots
from madoc.simulation.cpu import CpuSimulator
from own_robots import BOUNCER, BOUNCER_SPEC, CART_SPEC, task_of, write_robot


def test_a_servo_pulls_to_its_target(tmp_path):
    # kp (u - x) - kd v = 100 (0.1 - 0.04) - 2 * 0.5 = 5 N on 2 kg for one step of 0.01 s, twice.
    spec = CART_SPEC.replace(
        "means: force, low: -10, high: 10", "means: position, kp: 100, kd: 2, low: -200, high: 200, unit: mm"
    )
    spec = (
        spec.replace("control_step: 0.02", "control_step: 0.01")
        + "  - {field: actuator_gain, element: push, low: 50, high: 200}\n"
    )
    task = task_of(tmp_path, spec)
    simulator = CpuSimulator(task, threads=1)
    system = simulator.bind(np.array([[2.0, 100.0], [2.0, 50.0]]))
    end = system.step(np.full((2, 1, 2), [0.04, 0.5]), np.full((2, 1, 1), 0.5))
    # Half the gain, in its bias as well: 50 (0.1 - 0.04) - 1 = 2 N.
    np.testing.assert_allclose(end[:, 0, 1], [0.5 + 0.01 * 5 / 2, 0.5 + 0.01 * 2 / 2], rtol=1e-12)
    assert task.parameters.parameters[1].unit == "N/m"
    assert (task.actions[0].unit, task.actions[0].scale) == ("mm", 1e-3)
    model = simulator.model(np.array([2.0, 100.0]))
    assert model.actuator_ctrllimited.all()
    np.testing.assert_allclose(model.actuator_ctrlrange, [[-0.2, 0.2]])


def test_a_velocity_servo_and_its_limit(tmp_path):
    spec = CART_SPEC.replace("means: force, low: -10, high: 10", "means: velocity, kd: 4, limit: 3, low: -1, high: 1")
    spec = spec.replace("control_step: 0.02", "control_step: 0.01")
    system = CpuSimulator(task_of(tmp_path, spec), threads=1).bind(np.array([[1.0]]))
    # kd (u - v): 4 (0.5 - 0) = 2 N; 4 (1 - 0) = 4 N, of which 3 N are had.
    end = system.step(np.zeros((1, 2, 2)), np.array([[[0.5], [1.0]]]))
    np.testing.assert_allclose(end[0, :, 1], [0.02, 0.03], rtol=1e-12)


def test_actions_are_an_affine_map_and_rest_at_nothing(tmp_path):
    spec = CART_SPEC.replace("low: -10, high: 10", "low: 0, high: 4").replace(
        "control_step: 0.02", "control_step: 0.01"
    )
    task = task_of(tmp_path, spec + "  - {field: action_delay, low: 0, high: 0.01}\n")
    simulator = CpuSimulator(task, threads=1)
    assert simulator.initial_state.tolist() == [0.0, 0.0, -1.0]
    end = simulator.bind(np.array([[1.0, 0.0]])).step(np.zeros((1, 3, 3)), np.array([[[-1.0], [0.0], [1.0]]]))
    np.testing.assert_allclose(end[0, :, 1], [0.0, 0.02, 0.04], atol=1e-15)


def test_limits_that_the_model_gives_are_in_the_unit_of_the_action(tmp_path):
    model = BOUNCER.replace('joint="knee" gear="60"', 'joint="knee" ctrlrange="-0.02 0.03"')
    spec = BOUNCER_SPEC.replace("low: -1, high: 1}", "unit: mm}")
    (action,) = robots.load(write_robot(tmp_path, spec, bouncer=model)).task.actions
    assert (action.low, action.high, action.scale) == (pytest.approx(-20.0), pytest.approx(30.0), 1e-3)
