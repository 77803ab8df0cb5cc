"""One step of a search by hand: which trial is taken, when it has settled, and that known states are no unknowns."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import simulation
from madoc.calibration import CalibrationProblem
from madoc.calibration.least_squares.known_starts import KnownStarts
from madoc.calibration.least_squares.plan import Outcome, Plan, touched
from madoc.calibration.least_squares.search import Search
from madoc.calibration.least_squares.unknown_starts import UnknownStarts
from madoc.data import Disturbance, disturb
from madoc.identification.gauss_newton import FIRST_DAMPING, TRIALS
from madoc.identification.losses import ALL_FAILED
from madoc.identification.replay import window_residuals
from madoc.identification.windows import windows_at
from robots import SPRING_TRUTH, counted, recorded, spring

SPRING = spring(max_episode_steps=100)


def outcome(*totals, before=4.0):
    return Outcome(before, np.array(totals), np.zeros((len(totals), 0)), 0)


def test_the_step_that_helps_most_is_taken_and_its_damping_kept():
    assert outcome(3.0, 1.0, 2.0, 4.0).chosen() == (1, 1.0)
    assert outcome(1.0, 3.0, 2.0, 4.0).chosen() == (0, 1e-2)


def test_where_no_step_helps_none_is_taken_and_damping_grows():
    assert outcome(5.0, 4.0, 6.0, 4.0).chosen() == (3, 1e3)
    assert outcome(4.0, 4.0, 4.0, 4.0).chosen() == (3, 1e3)


def test_a_step_tried_alone_is_compared_with_staying():
    assert outcome(3.0).with_no_step().chosen() == (0, 1e-2)
    assert outcome(4.0).with_no_step().chosen() == (1, 1e3)


def test_the_share_that_a_step_saves():
    assert outcome(3.0, 1.0, 2.0, 4.0).saved(1) == pytest.approx(0.75)


def test_windows_left_out_make_a_search_worse_than_its_cost_says():
    plan = Plan(
        point=np.zeros(0),
        residuals=np.zeros((0, 0)),
        relative=np.zeros(0),
        kept=np.zeros(0, bool),
        steps=np.zeros((0, 0)),
        state_steps=np.zeros((0, 0, 0)),
        spread=np.zeros(0),
        scale=1.0,
        deviation=np.array([0.5]),
        bread=np.zeros((0, 0)),
        meat=np.zeros((0, 0)),
        failures=0,
        exact=False,
        left_out=0.25,
    )
    assert plan.comparable(2.0) == pytest.approx(2.0 * 0.25 + 0.25)
    assert replace(plan, left_out=1.0).comparable(2.0) == ALL_FAILED


@pytest.mark.parametrize("starts", [KnownStarts, UnknownStarts])
def test_one_search_finds_a_clean_spring_from_known_and_unknown_states(starts):
    problem = CalibrationProblem(
        recorded(SPRING, SPRING_TRUTH, 400, jax.random.key(0)), simulation.make(SPRING, threads=1)
    )
    search = Search(
        starts, "cauchy", horizon=5, windows=40, searches=2, search_windows=10, search_epochs=6, tolerance=1e-7
    )
    state, spent = search.init(problem, jax.random.key(1)), 0
    assert state.states.shape[1:] == ((0, 0) if starts is KnownStarts else (40, 2))
    for _ in range(25):
        (state, _), steps = counted(search.step, problem, state)
        spent += steps
        if search.settled(state):
            break
    assert search.settled(state)
    truth = SPRING.parameters.to_unit(SPRING.parameters.vector(SPRING_TRUTH))
    np.testing.assert_allclose(state.point[0], truth, atol=1e-5)
    longest = search.init(problem, jax.random.key(1))
    assert spent <= search.whole_run(problem, longest, refining_epochs=25)


@pytest.mark.parametrize(("free", "expected"), [(30, 0.02), (3, 1.0)])
def test_windows_with_contacts_weigh_less_where_they_are_explained_worse(free, expected):
    log = recorded(SPRING, SPRING_TRUTH, 100, jax.random.key(0))
    problem, rows = CalibrationProblem(log, simulation.make(SPRING, threads=1)), np.arange(100)
    touching = rows >= free
    starts = KnownStarts.at(problem, rows, touching, 1, "cauchy")
    noise = np.random.default_rng(0).standard_normal((100, 2))
    weights = starts._relative(np.where(touching, 50.0, 1.0)[:, None] * noise)
    assert (weights[~touching] == 1.0).all()
    assert weights[touching] == pytest.approx(expected, rel=0.5)
    assert not touched(problem, rows, 1).any()  # nothing touches a spring


def test_known_windows_leave_the_residuals_of_a_replay():
    log = recorded(SPRING, SPRING_TRUTH, 50, jax.random.key(0))
    problem, rows = CalibrationProblem(log, simulation.make(SPRING, threads=1)), np.array([3, 30])
    point = np.zeros((1, len(SPRING.parameters)))
    starts = KnownStarts.at(problem, rows, np.zeros(2, bool), 4, "linear")
    (plan,) = starts.plans(point, np.zeros((1, 0, 0)), np.ones(1), np.ones((1, 0)), refining=True)
    windows = windows_at(log, log.transitions.observation[rows], rows, 4)
    expected = window_residuals(problem.simulator, windows, point, problem.typical_change)[0]
    np.testing.assert_array_equal(plan.residuals, expected)
    assert (plan.steps[-1] == 0.0).all()


def test_states_of_smooth_motion_settle_at_once_and_parameters_move_by_plain_steps():
    log = disturb(
        recorded(SPRING, SPRING_TRUTH, 400, jax.random.key(0)), Disturbance(noise=0.1), SPRING, jax.random.key(1)
    )
    problem = CalibrationProblem(log, simulation.make(SPRING, threads=1))
    search = Search(UnknownStarts, "cauchy", 5, 40, 1, 10, 1, 1e-7)
    truth = SPRING.parameters.to_unit(SPRING.parameters.vector(SPRING_TRUTH))
    first = search.init(problem, jax.random.key(1))
    state = replace(first, point=truth[None], refining=1, waiting=1)
    point = state.point.copy()
    (state, _), spent = counted(search.step, problem, state)
    assert state.waiting == 0
    assert spent == 40 * 5 * (1 + 2 + 3)
    np.testing.assert_array_equal(state.point, point)
    (state, _), spent = counted(search.step, problem, state)
    derivatives, tried = 1 + len(truth) + 2, 1  # the first step helps, so no other is tried
    assert spent == 40 * 5 * (derivatives + tried)
    assert (state.point != point).all()
    assert state.damping[0] == FIRST_DAMPING * TRIALS[0]
    windows = UnknownStarts.at(problem, state.rows, 5, "cauchy")
    (plan,) = windows.plans(state.point, state.states, state.damping, state.state_damping, refining=True)
    astray = replace(plan, steps=np.concatenate([[1.0 - plan.point], plan.steps[1:]]))
    (outcome,), spent = counted(windows.outcomes, [astray], state.states, refining=True)
    assert spent == 40 * 5 * (tried + 4 * 3)  # it does not help: every step with every share of the states'
    assert outcome.chosen()[0] != 0
    # After many steps one of half a standard error settles, five times as long as before, and counts as an error.
    while not search.settled(state):
        before, state = state, search.step(problem, state)[0]
    patient, _ = replace(search, search_epochs=99).step(problem, before)
    assert state.moved[0] < patient.moved[0] <= 5.0 * state.moved[0]
    assert (np.diag(state.meat) > np.diag(patient.meat)).all()
