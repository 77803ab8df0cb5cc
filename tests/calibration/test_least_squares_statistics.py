from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem, LeastSquares
from madoc.calibration.least_squares.sentences import LONG_TAILS, about_residuals, have_long_tails
from madoc.calibration.least_squares.statistics import (
    autocorrelation,
    clipped_change,
    consecutive_residuals,
    outlier_limits,
    steady_cost,
    telling_first,
)
from madoc.calibration.least_squares.unknown_starts import FAILED_WINDOW, LIKE_NOISE
from madoc.data import Disturbance, disturb
from madoc.identification.noise import alternation
from madoc.identification.settling import cost_of_noise
from own_robots import BOUNCER, BOUNCER_SPEC, write_robot
from robots import SPRING_TRUTH, recorded, spring

NO_COUNTS = np.zeros(3)
LEG_TRUTH = {"body_mass.trunk": 2.0, "body_mass.leg": 0.5, "dof_damping.knee": 5.0}
CONTACT = "  - {field: contact_time, element: foot, low: 0.02, high: 0.1}\n"
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
    (before, after), spent = consecutive_residuals(problem, np.zeros(len(SPRING_TRUTH)), np.arange(50))
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
        return replace(search, cost=np.full(len(search.cost), cost), **{"steady_cost": cost} | changes)

    def long(search):
        return have_long_tails(problem, search)

    assert not long(costing(1.0))
    assert long(costing(1.2))
    assert about_residuals(problem, costing(1.2)) == (
        "residuals have longer tails than noise has: the intervals are too narrow, by how much is not known",
    )
    assert not long(costing(1.2, epochs=0))  # not all windows are known yet
    assert not long(costing(1.2, deviation=np.full(2, 1e-9)))  # rounding errors
    at_contacts = costing(1.2, steady_cost=1.0)
    assert not long(at_contacts)
    (sentence,) = about_residuals(problem, at_contacts)
    assert sentence.startswith("residuals have longer tails than noise has only where contacts begin or end")

    def leaving_out(count, **changes):
        return costing(1.0, explained=len(begun.rows) - count, **changes)

    assert not long(leaving_out(2))  # of 10
    assert long(leaving_out(3))
    assert not long(leaving_out(3, touching=np.arange(len(begun.rows)) == 0))  # as where a contact begins


def test_windows_with_and_without_contacts_have_their_own_noise_and_those_between_do_not_count():
    readings, random = 4, np.random.default_rng(0)
    resting, flying, landing = np.full((50, readings), 2), np.zeros((50, readings), int), np.zeros((50, readings), int)
    landing[:, 2:] = 1
    contacts = np.concatenate([resting, flying, landing])
    sizes = np.repeat([0.1, 1.0, 30.0], 50)[:, None, None]
    residuals, spare = sizes * random.standard_normal((150, readings, 3)), np.ones((150, readings, 3))
    expected = cost_of_noise("cauchy")[0]
    assert steady_cost(residuals, spare, contacts, NO_COUNTS, "cauchy") == pytest.approx(expected, rel=0.1)
    residuals[:50:3] *= 30.0  # every third resting window is not explained
    assert steady_cost(residuals, spare, contacts, NO_COUNTS, "cauchy") > LONG_TAILS
    few = slice(41, 109)  # of nine windows that rest, and nine that land; those that fly decide
    assert steady_cost(residuals[few], spare[few], contacts[few], NO_COUNTS, "cauchy") == pytest.approx(
        expected, rel=0.1
    )
    fewer = slice(91, 150)  # nine that fly are too few, so that all count
    residuals[100::3] *= 30.0
    assert steady_cost(residuals[fewer], spare[fewer], contacts[fewer], NO_COUNTS, "cauchy") > LONG_TAILS
    assert steady_cost(residuals[:0], spare[:0], contacts[:0], NO_COUNTS, "cauchy") == 0.0


def test_readings_of_something_at_rest_do_not_make_the_rounding_of_others_a_long_tail():
    """Two of three windows are at rest, to a tenth of the rounding of counts with which the third is read."""
    random, contacts, spare = np.random.default_rng(0), np.zeros((90, 4), int), np.ones((90, 4, 3))
    residuals = np.repeat([0.1, 0.1, 1.0], 30)[:, None, None] * random.uniform(-1.0, 1.0, (90, 4, 3)) * np.sqrt(3.0)
    assert steady_cost(residuals, spare, contacts, NO_COUNTS, "cauchy") > LONG_TAILS
    assert steady_cost(residuals, spare, contacts, np.ones(3), "cauchy") < 0.5


def test_every_other_of_the_windows_searched_first_tells_much(tmp_path):
    model = BOUNCER.replace('size=".05" pos', 'name="foot" size=".05" pos')
    spec = BOUNCER_SPEC.replace("max_episode_steps", CONTACT + "max_episode_steps")
    task = robots.load(write_robot(tmp_path, spec, bouncer=model)).task
    problem = CalibrationProblem(
        recorded(task, LEG_TRUTH | {"contact_time.foot": 0.03}, 1200, jax.random.key(0)),
        simulation.make(task, threads=1),
    )
    rows = np.random.default_rng(0).permutation(np.arange(0, 1190, 10))
    ordered = telling_first(problem, rows, 8, 40, 20)
    np.testing.assert_array_equal(np.sort(ordered), np.sort(rows))
    others = ordered[1:20:2]
    np.testing.assert_array_equal(others, [row for row in rows if row not in ordered[:20:2]][:10])
    counts = problem.simulator.contacts(problem.states.states)
    changes = [[len(np.unique(counts[row : row + 9])) > 1 for row in part] for part in (ordered[:20:2], rows)]
    assert np.mean(changes[0]) > np.mean(changes[1])  # landings and jumps tell of the contact's time constant
    np.testing.assert_array_equal(telling_first(problem, rows, 8, len(rows), 20), rows)  # all are drawn anyway


def test_nothing_changes_without_contacts():
    task = spring(max_episode_steps=100)
    problem = CalibrationProblem(recorded(task, SPRING_TRUTH, 400, jax.random.key(0)), simulation.make(task, threads=1))
    rows = np.random.default_rng(0).permutation(np.arange(0, 390, 10))
    np.testing.assert_array_equal(telling_first(problem, rows, 8, 20, 10), rows)
