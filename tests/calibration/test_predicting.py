"""The fit for prediction: where it begins, when it counts, and that it predicts better than short windows do."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem, LeastSquares
from madoc.calibration.least_squares.predicting import ROWS, MeasuredStarts, begun, better, search_of, windows_for
from madoc.calibration.least_squares.sentences import PREDICTS
from madoc.data import Disturbance, disturb
from madoc.identification.information import Uncertainty
from madoc.runs.checkpoint import difference, layout
from own_robots import PENDULUM_SPEC, write_robot
from robots import recorded

SPEC = PENDULUM_SPEC.replace("actions:", "  - {name: speed, reads: velocity(pivot)}\nactions:")
DRAG = "parameters:\n  - {field: dof_drag, element: pivot, low: 0, high: 1}"
"""What the true pendulum has besides, and the model lacks."""
TRUTH = {"body_mass.rod": 1.2, "dof_damping.pivot": 0.05, "actuator_gain.pivot": 2.5}


@pytest.fixture
def pendulum(tmp_path):
    return robots.load(write_robot(tmp_path, SPEC)).task


@pytest.fixture
def with_drag(tmp_path):
    (tmp_path / "drag").mkdir()
    return robots.load(write_robot(tmp_path / "drag", SPEC.replace("parameters:", DRAG))).task


def log_of(task, truth, seed):
    return recorded(task, truth, 4000, jax.random.key(seed))


def problem_of(task, log, noise=0.02):
    noisy = replace(disturb(log, Disturbance(noise=noise), task, jax.random.key(1)), disturbance=Disturbance())
    return CalibrationProblem(noisy, simulation.make(task, threads=1))


def ended(method, problem):
    state, epoch = method.init(problem, jax.random.key(0)), None
    while epoch is None or epoch.converged is None:
        state, epoch = method.step(problem, state)
    return state


def test_windows_last_a_second_and_are_not_drawn_from_a_log_that_is_too_short(pendulum):
    problem = problem_of(pendulum, log_of(pendulum, TRUTH, 0))
    search = search_of(problem, 8, 1e-7)
    assert (search.horizon, search.windows) == (50, ROWS // 50)
    state = windows_for(problem, search, jax.random.key(0))
    assert state.states.shape[1:] == (0, 0)
    assert (np.diff(np.sort(state.rows)) > 50).all()
    first = begun(state, np.array([0.1, 0.2, 0.3]))
    assert difference(layout(first), layout(state)) is None
    np.testing.assert_array_equal(first.point, [[0.1, 0.2, 0.3]])
    short = problem_of(pendulum, recorded(pendulum, TRUTH, 300, jax.random.key(0)))
    assert windows_for(short, search, jax.random.key(0)) is None


def test_errors_are_those_of_what_sensors_measured(pendulum):
    problem = problem_of(pendulum, log_of(pendulum, TRUTH, 0))
    rows = np.array([100, 900])
    starts = MeasuredStarts.at(problem, rows, np.zeros(2, bool), 4, "linear")
    (plan,) = starts.plans(np.zeros((1, 3)), np.zeros((1, 0, 0)), np.ones(1), np.ones((1, 0)), refining=True)
    measured = problem.states.measured
    assert plan.residuals.shape == (2, 4 * measured)
    state = problem.states.states[100]
    system = problem.simulator.bind(problem.simulator.parameters.middle[None])
    action = np.asarray(problem.dataset.transitions.action, np.float64)[100]
    after = system.observe(system.step(state[None, None], action[None, None]))[0, 0]
    seen = np.asarray(problem.dataset.transitions.next_observation)[100]
    wanted = (after - seen)[:measured] / problem.typical_change[:measured]
    np.testing.assert_allclose(plan.residuals[0, :measured], wanted, rtol=1e-6)


def test_it_counts_where_chance_hardly_moves_an_estimate_as_far(pendulum):
    """By hand: 3 parameters, 23 windows, standard errors of 0.1; F(3, 20) is above 8.10 once in a thousand.

    A distance of x standard errors in one of them is F = x² 20 / (3 · 22), so that x is above 5.17.
    """
    problem = problem_of(pendulum, log_of(pendulum, TRUTH, 0))
    state = windows_for(problem, search_of(problem, 8, 1e-7), jax.random.key(0))
    state = replace(state, bread=np.eye(3), meat=0.01 * np.eye(3), explained=23, epochs=1)
    state = replace(state, point=np.array([[0.3, 0.0, 0.0]]))
    assert better(state, np.array([0.3 - 0.51, 0.0, 0.0])) is None
    found = better(state, np.array([0.3 - 0.53, 0.0, 0.0]))
    np.testing.assert_allclose(found.shift, [0.53, 0.0, 0.0])
    both = found.of_both(Uncertainty(0.04 * np.eye(3), np.eye(3), np.zeros((0, 3))))
    np.testing.assert_allclose(both.covariance, np.diag([0.04 + 0.01 + 0.53**2, 0.05, 0.05]))
    assert better(replace(state, epochs=0), np.zeros(3) - 9.0) is None
    assert better(replace(state, explained=7), np.zeros(3) - 9.0) is None


def test_a_model_without_drag_predicts_better_by_it_and_a_right_model_keeps_its_estimate(pendulum, with_drag):
    right = ended(LeastSquares(), right_problem := problem_of(pendulum, log_of(pendulum, TRUTH, 0)))
    assert PREDICTS not in LeastSquares().estimate(right_problem, right).warnings
    truth = TRUTH | {"dof_drag.pivot": 0.1}
    problem, method = problem_of(pendulum, log_of(with_drag, truth, 0)), LeastSquares()
    state = ended(method, problem)
    found, before = method.estimate(problem, state), method.estimate(problem, replace(state, predicting=0))
    assert PREDICTS in found.warnings
    assert (found.interval[:, 0] <= before.mean).all()
    assert (before.mean <= found.interval[:, 1]).all()
    unseen = log_of(with_drag, truth, 5)
    errors = [error_over_a_second(pendulum, unseen, each.mean) for each in (found, before)]
    assert errors[0] < 0.95 * errors[1]


def error_over_a_second(task, log, values):
    """Root mean square error in rad of predictions from exact states."""
    simulator, rows = simulation.make(task, threads=1), np.arange(0, 3900, 50)
    states, action = np.asarray(log.transitions.observation, np.float64), np.asarray(log.transitions.action)
    after = np.asarray(log.transitions.next_observation, np.float64)
    at = rows[:, None] + np.arange(50)
    system = simulator.bind(values[None])
    return float(np.sqrt(np.mean((system.roll_out(states[None, rows], action[at][None])[0] - after[at])[..., 0] ** 2)))
