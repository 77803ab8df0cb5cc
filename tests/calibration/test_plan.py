from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem, LeastSquares
from madoc.calibration.least_squares.plan import (
    FEWEST,
    autocorrelation,
    clipped_change,
    consecutive_residuals,
    outlier_limits,
    without_contacts,
)
from madoc.calibration.least_squares.sentences import LONG_TAILS, about_residuals, have_long_tails
from madoc.calibration.least_squares.unknown_starts import FAILED_WINDOW, LIKE_NOISE, UnknownStarts
from madoc.data import Disturbance, disturb
from madoc.identification.noise import alternation
from own_robots import BOUNCER, BOUNCER_SPEC, write_robot
from robots import SPRING_TRUTH, counted, recorded, spring

LEG_TRUTH = {"body_mass.trunk": 2.0, "body_mass.leg": 0.5, "dof_damping.knee": 5.0}
LIMITS = {"least": LIKE_NOISE, "failed": FAILED_WINDOW}


def test_noise_takes_turns_and_a_wrong_model_does_not():
    noise = np.random.default_rng(0).normal(size=(3, 20_000, 1))
    before, after = noise[1] - noise[0], noise[2] - noise[1]
    assert alternation(before, after) == pytest.approx(0.5, abs=0.03)
    assert alternation(before + 3.0, after + 3.0) == 0.0
    assert alternation(noise[0], noise[1]) == pytest.approx(0.0, abs=0.03)
    assert alternation(before[:0], after[:0]) == 0.0


def test_rows_without_an_order_have_no_pairs():
    task = spring()
    log = disturb(
        recorded(task, SPRING_TRUTH, 50, jax.random.key(0)), Disturbance(shuffled="rows"), task, jax.random.key(1)
    )
    problem = CalibrationProblem(log, simulation.make(task, threads=1))
    (before, after), spent = counted(consecutive_residuals, problem, np.zeros(len(SPRING_TRUTH)), np.arange(50))
    assert (before.shape, after.shape, spent) == ((0, 2), (0, 2), 0)
    assert alternation(before, after) == 0.0


def test_one_channel_of_several_tells_of_noise_and_few_pairs_do_not():
    noise = np.random.default_rng(0).normal(size=(3, 20_000, 4))
    before, after = noise[1] - noise[0], noise[2] - noise[1]
    before[:, 1:], after[:, 1:] = noise[0, :, 1:], noise[1, :, 1:]  # which forget theirs in a row
    assert alternation(before[:8], after[:8]) == 0.0
    assert alternation(before, after) == pytest.approx(0.5, abs=0.03)


def test_chance_is_a_bar_and_no_discount():
    """Noise beside random forces nearly as large in 300 rows, where chance may make a correlation of 0.17."""
    noise, forces = np.random.default_rng(0).normal(size=(3, 300, 1)), np.random.default_rng(1).normal(size=(2, 300, 1))
    before, after = noise[1] - noise[0] + 0.8 * forces[0], noise[2] - noise[1] + 0.8 * forces[1]
    assert alternation(before, after) == pytest.approx(0.38, abs=0.08)
    assert alternation(before[:8], after[:8]) == 0.0


def test_what_is_unlike_the_others_is_measured_in_their_deviations():
    middle, reach = outlier_limits(np.array([[1.0, 2.0, 3.0, 4.0, 100.0]]), np.ones(5))
    np.testing.assert_allclose(middle, [[3.0]])
    np.testing.assert_allclose(reach, [[5.0 * 1.4826 * 1.0]])


def test_windows_in_which_nothing_happens_do_not_say_what_is_usual():
    cost = np.array([[0.0, 0.0, 0.0, 0.0, 5.0, 6.0, 7.0]])
    middle, reach = outlier_limits(cost, np.array([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0]))
    np.testing.assert_allclose(middle, [[6.0]])
    assert (cost[:, 4:] < middle + reach).all()


def test_a_window_thrown_across_a_contact_does_not_forbid_what_helps_the_others():
    # From their middle, 2, the changes are 1, 0, 1 and 98 away, so 5 · 1.4826 · 1 is how far is like the others.
    before, after = np.zeros(4), np.array([[1.0, 2.0, 3.0, 100.0]])
    change = clipped_change(before, after, np.ones(4), **LIMITS)
    np.testing.assert_allclose(change, [[1.0, 2.0, 3.0, 2.0 + 5.0 * 1.4826]])


def test_a_step_that_makes_simulations_fail_pays_for_it():
    before, after = np.ones(5), np.array([[0.9, 0.9, 0.9, 0.9, FAILED_WINDOW]])
    assert clipped_change(before, after, np.ones(5), **LIMITS).sum() > 0.0


def test_costs_never_fall_below_nothing():
    before, after = np.array([10.0, 10.0, 10.0, 0.1]), np.array([[1.0, 1.0, 1.0, 0.05]])
    np.testing.assert_allclose(clipped_change(before, after, np.ones(4), **LIMITS), after - before)


def test_where_most_windows_rest_the_others_are_not_done_without():
    change = clipped_change(np.ones(5), np.array([[1.0, 1.0, 1.0, 2.0, 2.0]]), np.ones(5), **LIMITS)
    np.testing.assert_allclose(change, [[0.0, 0.0, 0.0, 1.0, 1.0]])


def test_what_is_left_of_consecutive_readings_is_correlated_where_it_is_not_noise():
    # One window, two channels: products 2 and -1 + -1 over squares 3 and 3.
    residuals = np.array([[[1.0, 1.0], [1.0, -1.0], [1.0, 1.0]]])
    assert autocorrelation(residuals) == pytest.approx(2.0 / 3.0)
    assert autocorrelation(residuals[..., 1:]) == pytest.approx(-2.0 / 3.0)
    assert autocorrelation(0.1 * residuals) == pytest.approx(0.02 / 3.0)  # less than the noise says nothing
    assert autocorrelation(100.0 * residuals) == pytest.approx(2.0 / 3.0)  # 3 deviations at most


def test_tails_are_long_where_the_cost_is_above_that_of_noise():
    task = spring()
    problem = CalibrationProblem(recorded(task, SPRING_TRUTH, 100, jax.random.key(0)), simulation.make(task, threads=1))
    begun = LeastSquares(initial_states="estimated", windows=10).init(problem, jax.random.key(0)).unknown[0]
    search = replace(begun, refining=1, epochs=3, deviation=np.full(2, 0.1), explained=len(begun.rows))

    def costing(cost, **changes):
        return replace(search, cost=np.full(len(search.cost), cost), **{"tail_cost": cost} | changes)

    def long(search):
        return have_long_tails(problem, search)

    assert not long(costing(1.0))
    assert long(costing(1.2))
    assert about_residuals(problem, costing(1.2)) == (
        "residuals have longer tails than noise has: the intervals are too narrow, by how much is not known",
    )
    assert not long(costing(1.2, epochs=0))  # not all windows are known yet
    assert not long(costing(1.2, deviation=np.full(2, 1e-9)))  # rounding errors
    assert not long(costing(1.2, tail_cost=1.0))
    assert about_residuals(problem, costing(1.2, tail_cost=1.0)) == ()

    def leaving_out(count, **changes):
        return costing(1.0, explained=len(begun.rows) - count, **changes)

    assert not long(leaving_out(2))  # of 10
    assert long(leaving_out(3))


def test_rounding_of_counts_is_no_long_tail():
    """Two of three readings are at rest, to a tenth of the rounding of counts with which the third is read."""
    log = recorded(spring(), SPRING_TRUTH, 40, jax.random.key(0))
    problem = CalibrationProblem(log, simulation.make(spring(), threads=1))
    residuals = np.repeat([0.1, 0.1, 1.0], 30)[:, None] * np.random.default_rng(0).uniform(-1.7, 1.7, (90, 4))
    starts = UnknownStarts.at(problem, np.array([0, 10]), 1, "cauchy")
    deviation = np.full(2, 0.1)
    fine, coarse = (replace(starts, rounding=np.full(2, size))._tail_cost for size in (0.0, 1.0))
    assert fine(residuals / deviation[0], deviation) > LONG_TAILS
    assert coarse(residuals / deviation[0], deviation) < 0.5
    assert fine(residuals[:0], deviation) == 0.0


def test_windows_in_which_bodies_touch_are_left_out_where_the_others_suffice(tmp_path):
    task = robots.load(write_robot(tmp_path, BOUNCER_SPEC, bouncer=BOUNCER)).task
    problem = CalibrationProblem(recorded(task, LEG_TRUTH, 1200, jax.random.key(0)), simulation.make(task, threads=1))
    rows = np.arange(0, 1190, 10)
    touching = (problem.simulator.contacts(problem.states.states) > 0)[rows[:, None] + np.arange(9)].any(1)
    few = rows[np.flatnonzero(touching).tolist() + np.flatnonzero(~touching)[:7].tolist()]
    assert len(LEG_TRUTH) + FEWEST == 8
    np.testing.assert_array_equal(without_contacts(problem, rows, 8), rows[~touching])
    np.testing.assert_array_equal(without_contacts(problem, few, 8), few)
