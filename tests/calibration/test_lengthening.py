"""Longer windows: where they begin, when they are taken, when they are not."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem, LeastSquares
from madoc.calibration.least_squares.lengthening import (
    LONGER,
    continued,
    enough,
    hopeless,
    horizon_of,
    lengthened,
    noise_alone,
    tells_more,
)
from madoc.calibration.least_squares.search import Search
from madoc.calibration.least_squares.unknown_starts import UnknownStarts
from madoc.data import Disturbance, disturb
from madoc.runs.checkpoint import difference, layout, load, save
from madoc.types import Epoch
from own_robots import PENDULUM_SPEC, write_robot
from robots import PENDULUM, recorded

TRUTH = (1.2, 0.15, 1.6)


@pytest.fixture
def pendulum(tmp_path):
    return robots.load(write_robot(tmp_path, PENDULUM_SPEC)).task


def problem_of(task, *, rows=2000, noise=0.05):
    truth = dict(zip(task.parameters.names, TRUTH, strict=True))
    log = recorded(task, truth, rows, jax.random.key(0))
    if noise:
        log = replace(disturb(log, Disturbance(noise=noise), task, jax.random.key(1)), disturbance=Disturbance())
    return CalibrationProblem(log, simulation.make(task, threads=1))


def searches_of(problem):
    """A search on windows of five rows, with states that tell which window is which, and one on longer ones."""
    method = Search(UnknownStarts, "cauchy", 5, 40, 1, 4, 2, 1e-7)
    shorter = method.init(problem, jax.random.key(0))
    longer = lengthened(problem, shorter, 15, 3)
    return shorter, longer


def ended(method, problem):
    """The state in which it has nothing left to do, and the control steps until then."""
    state, epoch, spent = method.init(problem, jax.random.key(0)), Epoch(), 0
    while epoch.converged is None and spent < 2_000_000:
        state, epoch = method.step(problem, state)
        spent += epoch.control_steps
    assert epoch.converged
    return state, spent


def test_longer_windows_begin_where_shorter_ones_do_and_share_no_reading(pendulum):
    shorter, longer = searches_of(problem_of(pendulum))
    assert set(longer.rows) <= set(shorter.rows)
    assert (np.diff(longer.rows) >= 16).all()
    np.testing.assert_array_equal(longer.states[0], [shorter.states[0, shorter.rows == row][0] for row in longer.rows])


def test_they_go_on_from_the_states_that_were_found(pendulum):
    shorter, longer = searches_of(problem_of(pendulum))
    found = replace(shorter, point=np.full((1, 3), 0.3), states=shorter.rows[None, :, None] + np.array([0.0, 0.5]))
    first = continued(longer, found)
    np.testing.assert_array_equal(first.point, [[0.3, 0.3, 0.3]])
    np.testing.assert_array_equal(first.states, longer.rows[None, :, None] + np.array([0.0, 0.5]))
    assert difference(layout(first), layout(longer)) is None


def test_too_few_longer_windows_are_none(pendulum):
    problem = problem_of(pendulum, rows=120)
    shorter = Search(UnknownStarts, "cauchy", 5, 40, 1, 4, 2, 1e-7).init(problem, jax.random.key(0))
    assert lengthened(problem, shorter, 15, 3) is None
    assert lengthened(problem, shorter, 10_000, 3) is None


def test_longer_windows_may_leave_as_much_noise_as_the_first_and_no_echo(pendulum):
    shorter, longer = searches_of(problem_of(pendulum))
    shorter = replace(shorter, deviation=np.array([1.0, 2.0]))
    longer = replace(longer, deviation=np.array([1.1, 2.3]), explained=25)
    assert noise_alone(longer, shorter, 16)
    assert not noise_alone(replace(longer, deviation=np.array([1.0, 2.5])), shorter, 16)
    # Of 25 windows of 16 readings white noise seems correlated by 1 / 20, three times that by chance alone.
    assert noise_alone(replace(longer, autocorrelation=0.149), shorter, 16)
    assert not noise_alone(replace(longer, autocorrelation=0.151), shorter, 16)


def test_a_search_is_hopeless_from_its_third_step_on(pendulum):
    shorter, longer = (replace(each, explained=len(each.rows)) for each in searches_of(problem_of(pendulum)))
    shorter = replace(shorter, bread=np.eye(3), meat=np.eye(3))
    quiet = replace(longer, bread=9.0 * np.eye(3), meat=9.0 * np.eye(3), deviation=1.9 * shorter.deviation, epochs=3)
    loud, wide = replace(quiet, deviation=2.1 * shorter.deviation), replace(quiet, meat=900.0 * np.eye(3))
    assert not hopeless(quiet, shorter, shorter)
    for each in (loud, wide):
        assert hopeless(each, shorter, shorter)
        assert not hopeless(replace(each, epochs=2), shorter, shorter)


def test_windows_are_not_lengthened_where_too_few_would_be_explained(pendulum):
    shorter, longer = searches_of(problem_of(pendulum))
    count = len(longer.rows)
    assert enough(longer, replace(shorter, explained=len(shorter.rows)))
    fewest = (5 + 3) / count  # five windows more than parameters
    assert enough(longer, replace(shorter, explained=int(np.ceil(fewest * len(shorter.rows)))))
    assert not enough(longer, replace(shorter, explained=int((fewest - 1.0 / count) * len(shorter.rows))))


def test_longer_windows_say_more_if_intervals_are_narrower_and_as_many_are_explained(pendulum):
    shorter, longer = searches_of(problem_of(pendulum))
    shorter = replace(shorter, bread=np.eye(3), meat=np.eye(3), explained=len(shorter.rows))
    longer = replace(longer, bread=9.0 * np.eye(3), meat=9.0 * np.eye(3), explained=len(longer.rows))
    assert tells_more(longer, shorter)
    assert not tells_more(replace(longer, bread=np.eye(3), meat=4.0 * np.eye(3)), shorter)
    assert not tells_more(replace(longer, explained=7), replace(shorter, explained=0))


def test_where_motion_is_smooth_they_make_noise_matter_less(pendulum):
    problem, space = problem_of(pendulum, rows=4000), pendulum.parameters
    truth = space.vector(dict(zip(space.names, TRUTH, strict=True)))
    widths = []
    for horizon in (horizon_of(problem.dataset, 26), None):
        method = LeastSquares(horizon=horizon)
        state, _ = ended(method, problem)
        interval = method.estimate(problem, state).interval
        assert ((interval[:, 0] <= truth) & (truth <= interval[:, 1])).all()
        widths.append(interval[:, 1] - interval[:, 0])
    assert [search.epochs > 0 for search in state.unknown] == [True, False, True]  # the longest come first
    assert state.best == 2
    assert (widths[1] < 0.5 * widths[0]).all()


def test_what_follows_windows_that_fail(pendulum):
    """By hand: of three searches the last, on windows nine times as long as the first, has taken three steps."""
    problem, method = problem_of(pendulum, rows=4000), LeastSquares()
    state = method.init(problem, jax.random.key(0))
    count = len(problem.simulator.parameters)

    def search(length, **changed):
        each = state.unknown[length]
        done = {"moved": np.full(len(each.moved), 0.5), "cost": np.full(len(each.cost), 0.8)}
        done |= {"bread": 4.0**length * np.eye(count), "meat": 4.0**length * np.eye(count)}
        done |= {"explained": len(each.rows), "refining": 1, "epochs": 3}
        return replace(each, **{**done, **changed})

    def after(length, best=0, **searches):
        unknown = tuple(searches.get(f"of_{index}", each) for index, each in enumerate(state.unknown))
        at = replace(state, unknown=unknown, stage="lengthening", length=length, best=best)
        found = method._after_unknown(problem, at)
        return found.length, found.best, found.finished, found.unknown[found.length].epochs

    first, three, nine = search(0), search(1), search(2)
    assert after(0, of_0=first)[:3] == (2, 0, 0)
    assert after(2, of_0=first, of_2=nine)[1:3] == (2, 1)
    # It tells no more than the first, or is not at its end by far: the shorter ones have their turn.
    assert after(2, of_0=first, of_2=search(2, meat=1e6 * np.eye(count)))[:3] == (1, 0, 0)
    loud = search(2, deviation=2.5 * first.deviation, moved=np.array([9.0]))
    assert after(2, of_0=first, of_2=loud)[:3] == (1, 0, 0)
    # These serve, so the longest begin again from there, which ends if they fail once more.
    assert after(1, of_0=first, of_1=three, of_2=loud) == (2, 1, 0, 0)
    assert after(2, best=1, of_0=first, of_1=three, of_2=loud)[1:3] == (1, 1)
    # At their end, but with more than noise: the shorter ones have their turn, and are the estimate whatever they show.
    errors = [search(length, deviation=1.5 * first.deviation) for length in range(3)]
    assert after(2, of_0=first, of_2=errors[2])[:3] == (1, 0, 0)
    assert after(2, best=1, of_0=first, of_1=three, of_2=errors[2])[1:3] == (1, 1)
    assert after(1, of_0=first, of_1=errors[1], of_2=errors[2])[1:3] == (1, 1)
    assert after(1, of_0=first, of_1=search(1, deviation=2.5 * first.deviation, moved=np.array([9.0])))[:3] == (1, 0, 0)


def test_a_run_killed_on_longer_windows_goes_on_with_the_same_bits(pendulum, tmp_path):
    problem, method = problem_of(pendulum), LeastSquares()
    state = method.init(problem, jax.random.key(0))
    while state.length == 0 or not state.unknown[state.length].epochs:
        state, _ = method.step(problem, state)
    save(tmp_path / "checkpoint.npz", state, {})
    again, _ = load(tmp_path / "checkpoint.npz", method.init(problem, jax.random.key(0)))
    (state, _), (again, _) = (method.step(problem, each) for each in (state, again))
    for kept, resumed in zip(jax.tree.leaves(state), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(kept, resumed)


def test_longer_windows_cost_what_they_are_forecast_to(pendulum):
    problem = problem_of(pendulum)
    _, spent = ended(LeastSquares(), problem)
    forecast = LeastSquares().whole_run(problem, LeastSquares().init(problem, jax.random.key(0)), refining_epochs=6)
    assert 0.5 < spent / forecast < 1.5


def test_what_the_model_does_wrong_ends_them_at_the_first_longer_ones(pendulum, tmp_path):
    machine = tmp_path / "machine"
    machine.mkdir()
    rough = PENDULUM.replace('damping="0.1"', 'damping="0.1" frictionloss="0.02"')
    assert rough != PENDULUM
    of_machine = problem_of(robots.load(write_robot(machine, PENDULUM_SPEC, pendulum=rough)).task, noise=0.1)
    problem = CalibrationProblem(of_machine.dataset, simulation.make(pendulum, threads=1))
    state, _ = ended(LeastSquares(), problem)
    assert state.best == LONGER
    warnings = LeastSquares().estimate(problem, state).warnings
    assert any("residuals exceed the noise" in warning for warning in warnings)


def test_the_longest_windows_begin_where_shorter_ones_do(pendulum):
    searches = LeastSquares().init(problem_of(pendulum, rows=4000), jax.random.key(0)).unknown
    assert len(searches) == 3
    assert np.isin(searches[2].rows, searches[1].rows).all()
    assert np.isin(searches[1].rows, searches[0].rows).all()
