"""Least squares finds the truth of a robot of one's own: a delay, a bias and a shared value included."""

import jax
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem, LeastSquares, calibrate
from own_robots import ARM_SPEC, write_robot
from robots import recorded

TRUTH = {
    "body_mass.fore": 0.4,
    "damping": 0.3,
    "action_delay": 0.013,
    "signal_bias.shoulder_angle": 0.06,
    "signal_bias.elbow_speed": -0.2,
}
PARAMETERS = """\
parameters:
  - {field: body_mass, element: fore, low: 0.2, high: 1}
  - {field: dof_damping, elements: [shoulder, elbow], name: damping, low: 0, high: 1}
  - {field: action_delay, low: 0, high: 0.04}
  - {field: signal_bias, element: shoulder_angle, low: -0.1, high: 0.1}
  - {field: signal_bias, element: elbow_speed, low: -0.5, high: 0.5}
"""
EXACT = 1e-4
"""% of its range: where the switch of a delay crosses a physics step, slopes change."""


@pytest.fixture
def task(tmp_path):
    spec = ARM_SPEC[: ARM_SPEC.index("parameters:")] + PARAMETERS + "max_episode_steps: 100\n"
    return robots.load(write_robot(tmp_path, spec)).task


@pytest.mark.parametrize("horizon", [1, 4])
def test_delay_bias_and_a_shared_value(task, horizon):
    log = recorded(task, TRUTH, 1000, jax.random.key(100))
    problem = CalibrationProblem(log, simulation.make(task, threads=1))
    method = LeastSquares(horizon=horizon, windows=200)
    result = calibrate(method, problem, key=jax.random.key(0), budget=300_000)
    space = task.parameters
    error = 100.0 * np.abs(result.mean - space.vector(TRUTH)) / (space.high - space.low)
    assert (error < EXACT).all(), dict(zip(space.names, error, strict=True))
    assert result.status == "converged"
    assert [row.unit for row in result.parameters.values()] == ["kg", "N·m·s/rad", "s", "rad", "rad/s"]
