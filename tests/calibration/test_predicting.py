"""The fit for prediction: where it begins, when it counts, and that it predicts better than short windows do."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem, LeastSquares
from madoc.calibration.least_squares import predicting
from madoc.calibration.least_squares.predicting import Prediction, medians_of_three, predicts_better
from madoc.calibration.least_squares.sentences import PREDICTS
from madoc.data import Disturbance, disturb
from madoc.identification.information import Uncertainty
from madoc.identification.linearisation import Linearisation
from madoc.runs.checkpoint import difference, layout
from own_robots import PENDULUM_SPEC, write_robot
from robots import counted, recorded

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


def log_of(task, truth, seed, rows=4000):
    return recorded(task, truth, rows, jax.random.key(seed))


def problem_of(task, log, noise=0.02):
    noisy = replace(disturb(log, Disturbance(noise=noise), task, jax.random.key(1)), disturbance=Disturbance())
    return CalibrationProblem(noisy, simulation.make(task, threads=1))


def with_spikes(problem, share):
    """The same log with a share of its readings far off, each by itself."""
    seen = np.asarray(problem.dataset.transitions.observation, np.float64)
    rows = np.random.default_rng(0).permutation(len(seen) - 1)[: int(share * len(seen))] + 1
    wrong = seen.copy()
    wrong[rows] += 20.0 * problem.typical_change
    after = np.asarray(problem.dataset.transitions.next_observation, np.float64).copy()
    after[:-1] = wrong[1:]
    transitions = replace(problem.dataset.transitions, observation=wrong, next_observation=after)
    return CalibrationProblem(replace(problem.dataset, transitions=transitions), problem.simulator)


def ended(method, problem):
    state, epoch = method.init(problem, jax.random.key(0)), None
    while epoch is None or epoch.converged is None:
        state, epoch = method.step(problem, state)
    return state


def prediction(count, error=1.0):
    """The state of a fit of so many parameters on two windows, at the middle of all ranges."""
    none, rows = np.zeros(count), np.arange(2)
    held = {"rows": rows, "states": np.zeros((2, 1)), "kept": rows >= 0, "noise": 0.0}
    points = {"first": none, "best": none, "point": none, "covariance": np.zeros((count, count))}
    return Prediction("under way", **held, **points, error=error, damping=1.0, epochs=0, rounds=0)


def test_windows_last_a_second_and_there_are_none_in_a_log_that_is_too_short(pendulum):
    problem = problem_of(pendulum, log_of(pendulum, TRUTH, 0))
    state = predicting.windows_for(problem)
    assert predicting.steps_of_a_second(problem) == 50
    assert len(state.rows) == 20 * 3  # of 20 episodes of 200 rows
    assert (np.diff(state.rows) > 50).all()
    short = problem_of(pendulum, log_of(pendulum, TRUTH, 0, 400))
    assert predicting.windows_for(short) is None


def test_initial_states_are_fitted_to_the_readings_after_them_and_then_held(pendulum):
    problem, true = problem_of(pendulum, log_of(pendulum, TRUTH, 0)), log_of(pendulum, TRUTH, 0)
    state, point = predicting.windows_for(problem), pendulum.parameters.to_unit(pendulum.parameters.vector(TRUTH))
    begun, spent = counted(predicting.begun, problem, state, point, 20)
    assert spent > 0
    assert difference(layout(begun), layout(state)) is None
    angles = np.asarray(true.transitions.observation)[state.rows, 0]
    logged, fitted = (np.abs(each.states[:, 0] - angles).mean() for each in (state, begun))
    assert fitted < 0.6 * logged
    np.testing.assert_array_equal(begun.first, point)
    after, epoch = predicting.step(problem, begun)
    np.testing.assert_array_equal(after.states, begun.states)
    assert epoch.stage == "predicting"


def test_a_start_that_a_false_reading_spoils_is_left_out_and_no_reading_is_of_the_next_run(pendulum):
    log = log_of(pendulum, TRUTH, 0)
    problem = problem_of(pendulum, log)
    state, point = predicting.windows_for(problem), pendulum.parameters.to_unit(pendulum.parameters.vector(TRUTH))
    spoilt = state.rows[7]
    seen = np.array(problem.dataset.transitions.observation, np.float64)
    seen[spoilt : spoilt + 4] += 50.0 * problem.typical_change
    transitions = replace(problem.dataset.transitions, observation=seen, next_observation=np.roll(seen, -1, axis=0))
    false = CalibrationProblem(replace(problem.dataset, transitions=transitions), problem.simulator)
    begun = predicting.begun(false, state, point, 10_000)  # longer than a second, to the end of which windows fit
    assert not begun.kept[7]
    assert begun.kept.mean() > 0.9
    assert predicting._residuals(false, begun, point[None]).shape[1] == begun.kept.sum()


def test_a_window_that_fails_ends_the_fit_with_the_estimate_so_far(pendulum):
    problem = problem_of(pendulum, log_of(pendulum, TRUTH, 0))
    begun = predicting.begun(problem, predicting.windows_for(problem), np.zeros(3), 0)
    broken = replace(begun, states=np.where(np.arange(60)[:, None] == 3, np.nan, begun.states))
    after, _ = predicting.step(problem, broken)
    assert after.progress == "no better"
    assert predicting.step(problem, replace(broken, rounds=1))[0].progress == "better"
    np.testing.assert_array_equal(after.best, np.zeros(3))


def test_errors_of_noise_alone_end_the_fit(pendulum):
    """A right model's parameters, a little off, as short windows may tell them less precisely than a second does."""
    problem = problem_of(pendulum, log_of(pendulum, TRUTH, 0))
    point = pendulum.parameters.to_unit(pendulum.parameters.vector(TRUTH))
    for off, progress in ((1e-3, "no better"), (0.2, "under way")):
        begun = predicting.begun(problem, predicting.windows_for(problem), point + off, 20)
        assert begun.noise > 0.0
        assert predicting.step(problem, begun)[0].progress == progress


def test_an_estimate_is_better_by_more_than_chance_and_not_in_a_few_windows_alone():
    before = 1.0 + 0.1 * np.random.default_rng(0).standard_normal(40)
    noise = 0.1 * np.random.default_rng(1).standard_normal(40)
    assert predicts_better(0.95 * before, before)
    assert not predicts_better(0.995 * before, before)  # certain, but not worth it
    assert not predicts_better(0.99 * before + noise - noise.mean(), before)  # no more than its standard error
    assert not predicts_better(before, before)
    few = np.where(np.arange(40) < 12, 0.5, 1.01) * before  # much better in 12 of 40
    assert few.mean() < 0.9 * before.mean()
    assert not predicts_better(few, before)
    assert not predicts_better(np.full(40, np.inf), before)


def test_a_false_reading_is_no_median_of_three_and_a_lasting_error_is():
    values = np.array([0.0, 9.0, 0.1, 0.2, 0.3, 0.4, -9.0, 0.5])[:, None]
    np.testing.assert_array_equal(medians_of_three(values)[:, 0], [0.1, 0.2, 0.2, 0.3, 0.3, 0.4])


def test_squares_are_weighted_so_that_they_sum_up_to_the_errors_and_steps_lower_the_cost():
    """By hand: errors 1 and 2 with means of squares 1 and 4, so weights of 1 and 1/2, in windows of two values."""
    slopes = Linearisation(np.array([[1.0, 1.0], [2.0, -2.0]]), np.array([[[1.0], [1.0]], [[0.0], [2.0]]]))
    weighted = predicting._weighted(slopes)
    np.testing.assert_allclose((weighted.residuals**2).sum(-1), [1.0, 2.0])
    state = prediction(1, error=1.5)
    # Gradient (1 + 1) / 2 + (0 - 4) / 4 = 0 at the first estimate; at 0.15 the term pulls back by 3 / 0.15.
    np.testing.assert_allclose(predicting._step(state, slopes, 0.0), [0.0], atol=1e-12)
    away = predicting._step(replace(state, point=np.array([0.15])), slopes, 0.0)
    np.testing.assert_allclose(away, [-(3.0 / 0.15) / (1.0 + 1.0 + 3.0 / 0.15**2)])
    assert predicting._cost(state, np.array([0.15]), np.array([1.0, 2.0])) == pytest.approx(1.5 + 1.5 / 2)
    assert predicting._cost(state, np.zeros(1), np.array([1.0, np.inf])) == np.inf


def test_the_uncertainty_is_that_of_both_estimates_and_of_their_distance():
    state = replace(prediction(3), best=np.array([0.5, 0.0, 0.0]), covariance=0.01 * np.eye(3))
    both = state.of_both(Uncertainty(0.04 * np.eye(3), np.eye(3), np.zeros((0, 3))))
    np.testing.assert_allclose(both.covariance, np.diag([0.04 + 0.01 + 0.25, 0.05, 0.05]))


def test_a_model_without_drag_predicts_better_by_it_and_says_so(pendulum, with_drag):
    problem, method = problem_of(pendulum, log_of(with_drag, TRUTH | {"dof_drag.pivot": 0.1}, 0)), LeastSquares()
    state = ended(method, problem)
    assert state.prediction.progress == "better"
    worse = replace(state, prediction=replace(state.prediction, progress="no better"))
    found, before = method.estimate(problem, state), method.estimate(problem, worse)
    assert found.effective
    assert PREDICTS in found.warnings
    assert (found.interval[:, 0] <= before.mean).all()
    assert (before.mean <= found.interval[:, 1]).all()
    unseen = log_of(with_drag, TRUTH | {"dof_drag.pivot": 0.1}, 5)
    errors = [error_over_a_second(pendulum, unseen, each.mean) for each in (found, before)]
    assert errors[0] < 0.97 * errors[1]


@pytest.mark.parametrize("spikes", [0.0, 0.01])
def test_a_right_model_keeps_its_estimate_though_readings_be_false(pendulum, spikes):
    problem, method = problem_of(pendulum, log_of(pendulum, TRUTH, 0)), LeastSquares()
    problem = with_spikes(problem, spikes) if spikes else problem
    found = method.estimate(problem, ended(method, problem))
    assert not found.effective
    truth = [TRUTH[name] for name in pendulum.parameters.names]
    assert (found.interval[:, 0] <= truth).all()
    assert (truth <= found.interval[:, 1]).all()


def error_over_a_second(task, log, values):
    """Root mean square error in rad of predictions from exact states."""
    simulator, rows = simulation.make(task, threads=1), np.arange(0, 3900, 50)
    states, action = np.asarray(log.transitions.observation, np.float64), np.asarray(log.transitions.action)
    after = np.asarray(log.transitions.next_observation, np.float64)
    at = rows[:, None] + np.arange(50)
    system = simulator.bind(values[None])
    return float(np.sqrt(np.mean((system.roll_out(states[None, rows], action[at][None])[0] - after[at])[..., 0] ** 2)))
