"""Windows fitted with parameters and initial states: where the fit ends, what it costs, and windows that fail."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import simulation
from madoc.data import typical_change
from madoc.identification import fitted_windows
from madoc.identification.fitted_windows import Fit, alike, fit_windows, windows_of
from madoc.identification.linearisation import WindowSlopes
from madoc.identification.replay import Readings
from madoc.identification.states import states_of
from robots import SPRING_TRUTH, counted, recorded, spring


@pytest.fixture(scope="module")
def windows():
    """Windows of an exact log of the spring, logged initial states, and its simulator."""
    task = spring(max_episode_steps=100)
    simulator, dataset = simulation.make(task, threads=1), recorded(task, SPRING_TRUTH, 2000, jax.random.key(0))
    windows = windows_of(dataset, states_of(dataset, simulator), typical_change(dataset), fewest=30)
    readings, states = windows.readings, windows.states
    return simulator, readings, states


@pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (-0.9, 0.9, 0.9)], ids=["mid-range", "far away"])
def test_the_fit_ends_at_the_truth(windows, start):
    simulator, readings, states = windows
    fit = fit_windows(simulator, readings, states, np.array(start))
    truth = simulator.parameters.to_unit(simulator.parameters.vector(SPRING_TRUTH))
    assert fit.point == pytest.approx(truth, abs=1e-6)
    assert fit.states == pytest.approx(states, abs=1e-6)


def test_it_counts_what_it_simulates(windows, monkeypatch):
    simulator, readings, states = windows
    simulated, once = [], Readings.residuals

    def residuals(self, simulator, points, states):
        simulated.append(len(points) * states.shape[1] * self.steps)
        return once(self, simulator, points, states)

    monkeypatch.setattr(Readings, "residuals", residuals)
    assert counted(fit_windows, simulator, readings, states, np.zeros(3))[1] == sum(simulated)


def test_a_step_on_which_windows_fail_is_not_taken(windows, monkeypatch):
    simulator, readings, states = windows
    start = fitted_windows._sloped(simulator, readings, states, np.zeros(3))
    failing = np.full((len(fitted_windows.LENGTHS), 1, *start.slopes.residuals.shape), np.nan)
    failing[:, :, : len(states) // 3] = 0.0  # a third of the windows would be explained without a residual
    monkeypatch.setattr(Readings, "residuals", lambda *_: failing)
    after = fitted_windows._stepped(simulator, readings, start)
    assert after.point.tolist() == [0.0, 0.0, 0.0]
    assert after.slopes is start.slopes


def test_where_every_window_fails_the_start_is_kept(windows):
    simulator, readings, states = windows
    fit, spent = counted(fit_windows, simulator, readings, np.full_like(states, np.nan), np.zeros(3))
    assert fit.point.tolist() == [0.0, 0.0, 0.0]
    assert not fit.slopes.whole.any()
    of_states, by_both = 1 + 2 + 3, 1 + 2 * 3 + 2  # a step of the states with its three dampings, then all derivatives
    assert spent == (of_states + by_both) * len(readings) * readings.steps


def test_slopes_at_another_point_leave_out_windows_that_fail_there():
    slopes = WindowSlopes(np.ones((2, 3)), np.ones((2, 3, 1)), np.ones((2, 3, 2)), np.array([True, True]))
    moved = slopes.at(np.array([[2.0, 3.0, 4.0], [5.0, np.nan, 6.0]]))
    assert moved.whole.tolist() == [True, False]
    assert moved.residuals.tolist() == [[2.0, 3.0, 4.0], [0.0, 0.0, 0.0]]
    assert moved.by_parameters[:, 0, 0].tolist() == [1.0, 0.0]
    assert replace(moved, whole=slopes.whole).by_states[:, 0, 0].tolist() == [1.0, 0.0]


def test_episodes_of_ten_rows_have_windows_behind_their_first_row():
    task = spring(max_episode_steps=10)
    dataset, simulator = recorded(task, SPRING_TRUTH, 2000, jax.random.key(0)), simulation.make(task, threads=1)
    logged = states_of(dataset, simulator)
    windows = windows_of(dataset, logged, typical_change(dataset), fewest=30)
    assert windows.readings.steps == 9
    # Each begins at the second row of its episode, so that what came before is its first row, again and again.
    firsts = logged.states[dataset.episode_starts[windows.runs]]
    np.testing.assert_array_equal(windows.earlier, np.repeat(firsts[:, None], 9, axis=1))


def test_what_is_left_is_alike_in_a_row_where_it_is_not_noise():
    """By hand, in 100 windows of 5 readings of 3 signals: 4 products of neighbours to 5 squares."""
    readings, same = (
        Readings(np.zeros((100, 4, 1)), np.zeros((100, 5, 3)), np.ones(3), np.ones(2)),
        np.ones((100, 5, 3)),
    )

    def of(errors):
        slopes = WindowSlopes(errors.reshape(100, 15), *(np.zeros((100, 15, 0)),) * 2, np.ones(100, bool))
        return alike(Fit(np.zeros(0), np.zeros((100, 0)), slopes, np.zeros((100, 15, 0)), slopes.whole), readings)

    assert of(same) == pytest.approx(0.8)
    assert of(same * np.array([1.0, -1.0, 1.0, -1.0, 1.0])[:, None]) == pytest.approx(-0.8)
    assert of(1e-4 * same) == pytest.approx(0.008)  # rounding errors of a simulation are no sensor's
    small = same * np.array([1.0, 0.0, 0.0])  # a signal whose errors last, beside the noise of another
    loud = np.random.default_rng(0).standard_normal((100, 5, 3)) * np.array([0.0, 10.0, 0.0])
    assert abs(of(small + loud)) < 0.1
