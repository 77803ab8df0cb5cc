"""Actions of a spec: servos, limits and units, by hand."""

import re

import jax
import mujoco
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem, LeastSquares, calibrate
from madoc.commands.main import main
from madoc.data import logs
from madoc.errors import MadocError
from madoc.simulation.cpu import CpuSimulator
from madoc.verdict import assess
from own_robots import BOUNCER, BOUNCER_SPEC, CART_SPEC, task_of, write_robot
from robots import PENDULUM


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


FREE = """\
madoc: 1
name: free
model: pendulum.xml
control_step: 0.02
signals:
  - {name: angle, reads: position(pivot), unit: rad}
  - {name: speed, reads: velocity(pivot)}
actions: []
parameters:
  - {field: dof_damping, element: pivot, low: 0, high: 0.5}
"""


SWINGING = re.sub("<actuator>.*</actuator>", "", PENDULUM)


def test_a_machine_without_a_drive_is_calibrated_from_how_it_swings(tmp_path):
    robot, rng = robots.load(write_robot(tmp_path, FREE, pendulum=SWINGING)), np.random.default_rng(0)
    model, readings = robot.task.compile(), []
    model.dof_damping[0] = 0.06
    for start in (-2.0, -1.2, 0.8, 1.6):
        data = mujoco.MjData(model)
        data.qpos[0] = start
        for row in range(150):
            readings.append([0.02 * row, *(np.append(data.qpos, data.qvel) + 0.002 * rng.standard_normal(2))])
            mujoco.mj_step(model, data, 2)
    folder = tmp_path / "logs"
    folder.mkdir()
    for run, rows in enumerate(np.array(readings).reshape(4, 150, 3)):
        np.savetxt(folder / f"{run}.csv", rows, delimiter=",", header="time,angle,speed", comments="")
    assert main(["check", str(tmp_path / "robot.yaml"), "--data", str(folder), "--no-forecast"]) == 0
    dataset = logs.read(folder, robot)
    assert dataset.transitions.action.shape == (len(dataset), 0)
    train, held = dataset.split(0.25)
    problem = CalibrationProblem(train, simulation.make(robot.task, threads=1))
    assessed = assess(calibrate(LeastSquares(), problem, key=jax.random.key(0)), held)
    assert assessed.verdict.word == "CALIBRATED", assessed
    low, high = assessed.result.interval[0]
    assert low < 0.06 < high and high - low < 0.01


def test_a_reward_needs_an_action_and_an_actuator_has_to_be_driven(tmp_path):
    with pytest.raises(MadocError, match="line 8: a reward: is for a policy, which needs an action"):
        robots.load(write_robot(tmp_path, FREE + "reward: -angle ** 2\n", pendulum=SWINGING))
    with pytest.raises(MadocError, match="line 8: expected actions, as the model has the actuators pivot"):
        robots.load(write_robot(tmp_path, FREE))
