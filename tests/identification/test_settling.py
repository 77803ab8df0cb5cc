"""Initial states of windows: the cost of noise, a smooth robot in two steps, a contact by wide differences."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import simulation, tasks
from madoc.calibration import CalibrationProblem
from madoc.data import Disturbance, disturb
from madoc.identification import settling
from madoc.identification.ensembles import few_of, next_noise, with_contacts_settled
from madoc.identification.gauss_newton import FIRST_DAMPING
from madoc.identification.replay import Readings
from madoc.identification.settling import (
    FAILED_WINDOW,
    Settled,
    cost_of_noise,
    restart,
    settle,
    settled_to_noise,
    window_costs,
)
from robots import SPRING_TRUTH, counted, recorded, spring


def windows(task, truth, steps, noise):
    """Readings of windows, and their initial states as read with noise."""
    simulator, readings, guesses, _ = logged_windows(task, truth, steps, noise)
    return simulator, readings, guesses


def logged_windows(task, truth, steps, noise, length=600):
    """The same, with the problem and the rows that windows begin at."""
    log = recorded(task, truth, length, jax.random.key(0))
    noisy = replace(disturb(log, Disturbance(noise=noise), task, jax.random.key(1)), disturbance=Disturbance())
    problem = CalibrationProblem(noisy, simulation.make(task, threads=1))
    rows = np.arange(0, length - steps, steps + 1)
    rows = rows[rows % task.max_episode_steps + steps < task.max_episode_steps]
    readings = Readings.at(noisy, problem.states, rows, steps, problem.typical_change)
    guesses = problem.states.states[np.searchsorted(problem.states.rows, rows)]
    return problem.simulator, readings, guesses, (problem, rows)


def descended(simulator, readings, guesses, point, widths):
    states, damping, errors = guesses, np.full(len(guesses), FIRST_DAMPING), np.zeros(len(readings.spread))
    for width in widths:
        after = settle(simulator, readings, point, states, damping, width * errors, "cauchy")
        states, damping, errors = after.states, after.damping, after.errors
    return after


def test_the_cost_of_normal_noise():
    assert cost_of_noise("linear") == pytest.approx((1.0, np.sqrt(2.0)))
    draws = np.random.default_rng(0).standard_normal((400_000, 1))
    costs = window_costs(draws, "cauchy")
    assert cost_of_noise("cauchy") == pytest.approx((costs.mean(), costs.std()), rel=0.01)
    assert window_costs(np.array([[np.nan]]), "cauchy") == FAILED_WINDOW


def test_a_window_is_unexplained_beyond_three_deviations_of_its_cost():
    limit = 1.0 + 3.0 * np.sqrt(2.0) / 10.0
    costs = np.array([1.0, limit - 1e-6, limit + 1e-6])
    some = Settled(np.zeros((3, 1)), np.ones(3), np.ones(1), np.ones(1), costs, costs > 2.0, 0)
    assert some.unexplained(100, "linear").tolist() == [False, False, True]


def test_states_of_a_smooth_robot_settle_in_two_steps_at_any_width():
    task = spring(max_episode_steps=100)
    simulator, readings, guesses = windows(task, SPRING_TRUTH, 9, 0.1)
    point = task.parameters.to_unit(task.parameters.vector(SPRING_TRUTH))
    narrow, spent = counted(descended, simulator, readings, guesses, point, (0, 0))
    wide = descended(simulator, readings, guesses, point, (0, 3))
    np.testing.assert_allclose(narrow.states, wide.states, atol=2e-4)
    np.testing.assert_allclose(narrow.deviation, 0.1, rtol=0.3)
    assert not narrow.unexplained(readings.observed[0].size, "cauchy").any()
    assert spent == 2 * len(readings) * 6 * readings.steps


def test_wide_differences_and_restarts_find_states_at_contacts():
    task = tasks.make("halfcheetah", "legacy")
    truth = dict(zip(task.parameters.names, task.parameters.middle.tolist(), strict=True))
    simulator, readings, guesses, (problem, rows) = logged_windows(task, truth, 5, 0.1, length=600)
    point, values = np.zeros(len(truth)), readings.observed[0].size
    narrow = descended(simulator, readings, guesses, point, np.zeros(1 + len(settling.WIDTHS)))
    wide = descended(simulator, readings, guesses, point, (0.0, *settling.WIDTHS))
    again = wide
    for seed in range(settling.ANEW):  # as many as the fit for prediction takes
        again = restart(simulator, readings, point, guesses, again, "cauchy", np.random.default_rng(seed))
    missed = [int(each.unexplained(values, "cauchy").sum()) for each in (narrow, wide, again)]
    assert missed[0] > 1.5 * missed[1] > 0
    assert missed[2] < missed[1]
    assert (again.costs <= wide.costs).all()
    given = problem.dataset, problem.states, simulator, readings, rows, point, guesses
    states, spent = counted(with_contacts_settled, *given)
    residuals = readings.residuals(simulator, point[None], states[None])[0, 0] / np.tile(wide.deviation, 6)
    drawn = replace(wide, costs=window_costs(residuals, "cauchy"))
    assert drawn.unexplained(values, "cauchy").sum() <= missed[1]
    assert spent > len(readings) * readings.steps


def test_new_beginnings_end_once_one_explains_hardly_any_more_windows(monkeypatch):
    simulator, readings, guesses = windows(spring(max_episode_steps=100), SPRING_TRUTH, 9, 0.1)
    point, costs = np.zeros(len(simulator.parameters)), iter([1.0, 0.5, 0.49, 0.0])
    high = cost_of_noise("cauchy")[0] * 10.0

    def left(share):
        many = np.where(np.arange(len(readings)) < share * len(readings), high, 0.0)
        return Settled(guesses, np.ones(len(readings)), np.ones(2), np.ones(2), many, many > 0.0, 0)

    monkeypatch.setattr(settling, "settled", lambda *_: left(next(costs)))
    monkeypatch.setattr(settling, "restart", lambda *_: left(next(costs)))
    after = settled_to_noise(simulator, readings, point, guesses)
    assert after.unexplained(readings.observed[0].size, "cauchy").mean() == pytest.approx(0.49, abs=0.02)
    assert next(costs) == 0.0  # the last beginning was not tried


def test_few_states_have_the_mean_of_all_and_noise_follows_the_size_of_errors():
    members = np.arange(8.0).reshape(1, 4, 2) ** 2
    few = few_of(members, 2, 1)
    np.testing.assert_allclose(few[..., 0].mean(), members[..., 0].mean())
    np.testing.assert_allclose(few[0, 1, 0] - few[0, 0, 0], 4.0 * np.sqrt(0.75 * 2.0))
    many = np.random.default_rng(0).standard_normal((4000, 16, 1))
    assert few_of(many, 4, 1).var() == pytest.approx(1.0, rel=0.05)
    np.testing.assert_array_equal(few[..., 1], members[:, :2, 1])  # an action that is pending
    noise, rounding = np.array([0.1, 0.1, 0.1, 1e-3, 1.0]), np.array([0.0, 0.04, 0.0, 0.0, 0.0])
    ratio = np.array([9.0, 0.09, 1e-9, 0.5, 1.0])  # at most twice as large, at least the root of a tenth
    np.testing.assert_allclose(next_noise(noise, ratio, rounding), [0.2, 0.04, 0.1 * np.sqrt(0.1), 1e-3, 1.0])
