"""Where most of what a model leaves unexplained is: a stretch, a run, a signal, or nowhere."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc.identification.concentration import Concentration, concentration
from madoc.identification.concentration import alike as alike_in_a_row
from madoc.identification.fitted_windows import Fit, LoggedWindows
from madoc.identification.linearisation import WindowSlopes
from madoc.identification.replay import Readings
from robots import SPRING_TRUTH, recorded, spring

STEPS, SIGNALS = 4, ("height", "speed", "force")


def found(errors, names=None):
    """The concentration of errors by (window, reading, signal): 20 windows of 4 rows in each of 5 runs of 100 rows."""
    task = spring(max_episode_steps=100)
    dataset = recorded(task, SPRING_TRUTH, 500, jax.random.key(0))
    dataset = replace(dataset, run_names=names)
    rows = np.arange(100) * 5
    none, values, changes = np.zeros((100, 0)), STEPS * 3 + 3, np.ones(3)
    readings = Readings(np.zeros((100, STEPS, 1)), np.zeros(errors.shape), changes, np.ones(2))
    windows = LoggedWindows(readings, none, none, none[:, None], dataset.episode_of(rows), rows)
    slopes = WindowSlopes(errors.reshape(100, values), *(np.zeros((100, values, 0)),) * 2, np.ones(100, bool))
    fit = Fit(np.zeros(0), none, slopes, np.zeros((100, values, 0)), slopes.whole)
    return concentration(dataset, windows, fit, SIGNALS, 0.01)


def alike():
    """Errors of the same size everywhere."""
    return np.ones((100, STEPS + 1, 3))


def test_errors_that_are_alike_everywhere_are_nowhere():
    assert found(alike()) is None
    assert found(0.0 * alike()) is None


def test_a_stretch_is_told_by_its_run_and_time():
    errors = alike()
    errors[42:45] *= 10.0  # rows 210 to 224; two of the three hold half, from row 10 to 19 of their run
    stretch = found(errors)
    assert stretch.run == "run 3"
    assert stretch.share == pytest.approx(200 / 397)
    assert stretch.seconds == pytest.approx((0.1, 0.19))


def test_a_whole_run_is_told_where_it_stands_out():
    errors = alike()
    errors[20:40] *= 3.0  # a fifth of the windows, with 180 of 260 squares
    whole = found(errors)
    assert (whole.run, whole.seconds) == ("run 2", None)
    assert whole.share == pytest.approx(180 / 260)


def test_times_in_pieces_of_a_run_are_not_told():
    errors = alike()
    errors[42:45] *= 10.0
    assert found(errors, ("a.csv", "b.csv", "b.csv", "b.csv", "b.csv")).seconds is None


def test_a_signal_is_told_where_it_has_most():
    errors = alike()
    errors[..., 1] *= 3.0
    assert found(errors) == Concentration(0.0, "", "speed")


def test_what_is_left_is_alike_in_a_row_where_it_is_not_noise():
    """By hand, in 100 windows of 5 readings of 3 signals: 4 products of neighbours to 5 squares."""
    readings = Readings(np.zeros((100, STEPS, 1)), np.zeros((100, 5, 3)), np.ones(3), np.ones(2))

    def of(errors):
        slopes = WindowSlopes(errors.reshape(100, 15), *(np.zeros((100, 15, 0)),) * 2, np.ones(100, bool))
        fit = Fit(np.zeros(0), np.zeros((100, 0)), slopes, np.zeros((100, 15, 0)), slopes.whole)
        return alike_in_a_row(fit, readings)

    assert of(alike()) == pytest.approx(0.8)
    assert of(alike() * np.array([1.0, -1.0, 1.0, -1.0, 1.0])[:, None]) == pytest.approx(-0.8)
    assert of(1e-4 * alike()) == pytest.approx(0.008)  # rounding errors of a simulation are no sensor's
    small = alike() * np.array([1.0, 0.0, 0.0])  # a signal whose errors last, beside the noise of another
    loud = np.random.default_rng(0).standard_normal((100, 5, 3)) * np.array([0.0, 10.0, 0.0])
    assert abs(of(small + loud)) < 0.1
