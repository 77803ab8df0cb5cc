"""Least squares and OTED find the truth of robots small enough for seconds."""

import jax
import numpy as np
import pytest

from madoc import simulation
from madoc.calibration import CalibrationProblem, LeastSquares, Oted, calibrate
from madoc.data import Disturbance, disturb
from robots import ARM_TRUTH, SPRING_TRUTH, recorded, spring, two_link_arm

ROBOTS = {"spring": (spring(max_episode_steps=100), SPRING_TRUTH), "arm": (two_link_arm(), ARM_TRUTH)}
EXACT = 1e-6
"""% of its range that least squares may be off on clean data, ..."""
NOISY = 2.0
"""... with noise of 1 % of a step's change, ..."""
MATCHED = 10.0
"""... and, on average over parameters, OTED: states and actions alone say little of an arm's masses."""


def off(method, robot, *, rows, budget, noise=0.0):
    """How far each parameter is from the truth, in % of its range, and the result."""
    task, truth = ROBOTS[robot]
    log = recorded(task, truth, rows, jax.random.key(100))
    log = disturb(log, Disturbance(noise=noise), task, jax.random.key(101))
    problem = CalibrationProblem(log, simulation.make(task, threads=1))
    result = calibrate(method, problem, key=jax.random.key(0), budget=budget)
    space = task.parameters
    return 100.0 * np.abs(result.mean - space.vector(truth)) / (space.high - space.low), result


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("method", [LeastSquares(), LeastSquares(loss="linear"), LeastSquares(horizon=4, windows=100)])
def test_least_squares_is_exact_on_clean_states(robot, method):
    error, result = off(method, robot, rows=1000, budget=200_000)
    assert (error < EXACT).all(), error
    assert result.status == "converged"
    assert not result.warnings


@pytest.mark.parametrize("robot", ROBOTS)
def test_least_squares_is_near_on_noisy_states_and_says_that_they_are_noisy(robot):
    error, result = off(LeastSquares(windows=5000), robot, rows=5000, budget=10**6, noise=0.01)
    assert (error < NOISY).all(), error
    assert any("observation noise of 1 %" in warning for warning in result.warnings)


QUICK_OTED = Oted(draws=100, hidden=(64, 64), cloning_epochs=20, average_rate=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
def test_oted_finds_what_visits_the_same_states(robot):
    error, _ = off(QUICK_OTED, robot, rows=20_000, budget=300_000)
    assert error.mean() < MATCHED, error
