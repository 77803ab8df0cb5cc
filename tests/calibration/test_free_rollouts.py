from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import simulation
from madoc.calibration import CalibrationProblem, CmaEs, LeastSquares, Madoc, Oted
from madoc.calibration.free_rollouts import noise_deviation, rows_compared, with_sensor_noise
from madoc.calibration.least_squares.lengthening import horizon_of
from madoc.calibration.madoc.state import geometry
from madoc.data import Disturbance, disturb, observed_task, stride
from madoc.data.disturbing import row_change
from madoc.errors import MadocError
from madoc.simulation.rollout import Rollout
from madoc.types import Transitions
from robots import ARM_TRUTH, recorded, two_link_arm

KEY = jax.random.key(0)
WHOLE = replace(two_link_arm(), velocities=2)


@pytest.fixture(scope="module")
def log():
    return recorded(WHOLE, ARM_TRUTH, 300, KEY)


def problem_of(log, **disturbance):
    shown = disturb(log, Disturbance(**disturbance), WHOLE, KEY)
    return CalibrationProblem(shown, simulation.make(observed_task(WHOLE, shown), threads=1))


def collection_of(problem, method=None):
    return (method or Madoc())._collection(problem, np.zeros(problem.simulator.task.observation_size))


def test_windows_are_as_long_as_the_observation_wants(log):
    seen, hidden = problem_of(log), problem_of(log, hidden_velocities=True)
    derived = problem_of(log, hidden_velocities=True, velocities="differences")
    assert [collection_of(problem).scaling.length for problem in (seen, hidden, derived)] == [1, 3, 3]
    assert collection_of(hidden, Madoc(window=5)).scaling.length == 5
    with pytest.raises(MadocError, match=r"no episode .* has the 301 rows of a window; take a shorter one"):
        seen.features.windows("standardised", 301)


def test_many_parameters_have_more_draws_for_a_shorter_time():
    assert [geometry(count) for count in (16, 17)] == [(20, 50), (100, 10)]


def test_as_many_rows_are_compared_as_tell_a_state(log):
    problems = (problem_of(log), problem_of(log, hidden_velocities=True))
    assert [rows_compared(problem) for problem in problems] == [1, 3]
    unordered = problem_of(log, hidden_velocities=True, shuffled="rows")
    assert rows_compared(unordered) == 1
    assert collection_of(unordered).scaling.length == 1


def test_baselines_start_at_logged_states_where_those_are_known(log):
    seen, hidden = problem_of(log), problem_of(log, hidden_velocities=True)
    blind = CalibrationProblem(
        log, simulation.make(replace(WHOLE, state_from_observation=None, posture=None), threads=1)
    )
    assert [Oted()._anew(problem) for problem in (seen, hidden, blind)] == [True, False, False]
    assert [CmaEs("distribution")._acts(problem) for problem in (seen, hidden, blind)] == [False, True, True]


def test_noise_that_simulated_readings_are_given_is_told():
    exact = recorded(WHOLE, ARM_TRUTH, 300, KEY)
    problem = problem_of(exact)
    told = noise_deviation(problem, 0.1, 1)
    np.testing.assert_allclose(told, 0.1 / np.sqrt(1.02) * problem.row_change)
    (warning,) = Madoc()._collection(problem, told).warnings
    assert warning == "simulated observations were given sensor noise of up to 9.9 % of a step's change"
    assert collection_of(problem).warnings == ()


@pytest.mark.slow
@pytest.mark.parametrize(("rows", "share", "short"), [(1, 0.1, 0.2), (3, 0.1, 0.5)])
def test_noise_is_estimated_from_a_log_that_declares_none(rows, share, short):
    # Of windows the estimate is a lower bound.
    exact = recorded(WHOLE, ARM_TRUTH, 3000, KEY)
    shown = replace(disturb(exact, Disturbance(noise=share), WHOLE, KEY), disturbance=Disturbance())
    clean, problem = (CalibrationProblem(log, simulation.make(WHOLE, threads=1)) for log in (exact, shown))
    found = noise_deviation(problem, None, rows) / clean.row_change
    assert (found > (1.0 - short) * share - 0.01).all() and (found < 1.2 * share + 0.01).all()


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_noise_that_nobody_declared_is_estimated_once_the_regression_has_learnt(share):
    exact = recorded(WHOLE, ARM_TRUTH, 1000, KEY)
    shown = replace(disturb(exact, Disturbance(noise=share), WHOLE, KEY), disturbance=Disturbance())
    clean, problem = (CalibrationProblem(log, simulation.make(WHOLE, threads=1)) for log in (exact, shown))
    method = Madoc(cloning_epochs=0, regression_hidden=(64, 64), regression_epochs=6, batch=128)
    state = method.init(problem, KEY)
    for _ in range(method.regression_epochs):
        assert not state.noise.any()
        state, _ = method.step(problem, state)
    np.testing.assert_allclose(state.noise / clean.row_change, share, rtol=0.25, atol=0.01)


def test_noise_is_a_share_of_the_change_from_row_to_row_at_any_rate():
    log = recorded(replace(WHOLE, max_episode_steps=300), ARM_TRUTH, 300, KEY)
    time = 0.02 * np.arange(301)[:, None] * np.ones(4)
    smooth = replace(log.transitions, observation=np.sin(time[:-1]), next_observation=np.sin(time[1:]))
    slow = replace(log, transitions=smooth)
    assert stride(slow) > 1
    noisy = disturb(slow, Disturbance(noise=0.1), WHOLE, KEY)
    put_on = np.asarray(noisy.transitions.observation - smooth.observation).std(0)
    np.testing.assert_allclose(0.1 * row_change(slow), put_on, rtol=0.1)


def test_sensor_noise_is_not_that_of_the_actions():
    places = np.zeros((4, 2, 3, 1))
    never = np.zeros((4, 2, 3), dtype=bool)
    rollout = Rollout(Transitions(places, places, places[..., 0], places, never, never), ~never)
    seen = with_sensor_noise(rollout, np.ones(1), KEY).transitions.observation
    actions = [jax.random.normal(jax.random.fold_in(KEY, step), (2, 3, 1)) for step in range(10)]
    assert not any(np.isclose(seen[0], np.asarray(action)).any() for action in actions)


def test_a_reading_that_ends_a_row_begins_the_next():
    places = np.zeros((4, 2, 3, 1))
    never = np.zeros((4, 2, 3), dtype=bool)
    rows = Transitions(places, places, places[..., 0], places, never, never)
    rollout = Rollout(rows, np.ones((4, 2, 3), dtype=bool))
    seen = with_sensor_noise(rollout, np.array([2.0]), KEY).transitions
    np.testing.assert_array_equal(seen.next_observation[:-1], seen.observation[1:])
    assert seen.observation.std() == pytest.approx(2.0, rel=0.5)
    assert with_sensor_noise(rollout, np.zeros(1), KEY) is rollout


def test_horizons_follow_how_fast_a_robot_moves(log):
    walk = np.cumsum(np.random.default_rng(0).normal(size=(301, 4)), axis=0)
    slow = replace(log, transitions=replace(log.transitions, observation=walk[:-1], next_observation=walk[1:]))
    assert horizon_of(slow, 2) == slow.time_scale > 10
    assert horizon_of(slow, 50) == 5  # 50 windows of 6 readings in 300 rows
    jumps = np.random.default_rng(0).normal(size=(300, 4))
    fast = replace(log, transitions=replace(log.transitions, observation=jumps, next_observation=jumps[::-1]))
    assert horizon_of(fast, 30) == 3


def test_initial_states_are_estimated_where_the_data_asks_for_it(log):
    stages = {
        "undecided": {},
        "starting": {"noise": 0.1},
        "estimated": {"hidden_velocities": True},
    }
    for stage, disturbance in stages.items():
        assert LeastSquares().init(problem_of(log, **disturbance), KEY).stage == stage
    assert LeastSquares(initial_states="logged").init(problem_of(log, noise=0.1), KEY).stage == "logged"
    with pytest.raises(MadocError, match="does not determine its state"):
        LeastSquares(initial_states="logged").init(problem_of(log, hidden_velocities=True), KEY)


def test_too_few_readings_for_the_states_are_refused(log):
    hidden = problem_of(log, hidden_velocities=True)
    with pytest.raises(MadocError, match=r"got .* windows of 1 rows with .* take a longer horizon"):
        LeastSquares(horizon=1).init(hidden, KEY)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"window": 0}, "window"),
        ({"sensor_noise": -0.1}, "expected sensor_noise of Madoc to be greater than or equal to 0, got -0.1"),
    ],
)
def test_impossible_windows_and_noise_are_refused(wrong, sentence):
    with pytest.raises(MadocError, match=sentence):
        Madoc(**wrong)
