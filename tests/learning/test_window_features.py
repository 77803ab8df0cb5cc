import numpy as np
import pytest

from madoc.learning.dynamics_ratio import Scaling
from madoc.learning.window_features import (
    WindowScaling,
    last_rows,
    logged_stretch,
    rolled_stretch,
    turn,
    unbroken,
)
from madoc.types import Transitions


def walk(places, actions):
    """Rows of one channel that go on from each other."""
    places, actions = np.asarray(places, np.float64)[:, None], np.asarray(actions, np.float64)[:, None]
    empty = np.zeros(len(actions))
    return Transitions(places[:-1], actions, empty, places[1:], empty, empty)


ROWS = walk([0.0, 1.0, 3.0, 6.0, 10.0], [0.1, 0.2, 0.3, 0.4])


def test_windows_end_in_rows_of_their_own_episode():
    np.testing.assert_array_equal(last_rows(6, np.array([0, 4]), 3), [2, 3])
    np.testing.assert_array_equal(last_rows(6, np.array([0, 4]), 1), np.arange(6))


def test_a_window_holds_the_rows_up_to_its_last():
    observation, action, following = logged_stretch(ROWS, np.array([1, 3]), 2)
    np.testing.assert_array_equal(observation[..., 0], [[0.0, 3.0], [1.0, 6.0]])
    np.testing.assert_array_equal(action[..., 0], [[0.1, 0.3], [0.2, 0.4]])
    np.testing.assert_array_equal(following[..., 0], [[1.0, 6.0], [3.0, 10.0]])


def test_features_by_hand():
    # Offsets 0 and spreads 1, 2 (s, a) and 4 (s' - s); the turn of both windows is 1, and never varies: scale 1.
    scaling = Scaling(np.zeros(2), np.array([1.0, 2.0]), np.array([4.0]), difference=True)
    stretch = logged_stretch(ROWS, np.array([1, 3]), 2)
    np.testing.assert_array_equal(turn(stretch)[:, 0], [1.0, 1.0])
    windows = WindowScaling.of(scaling, stretch)
    assert windows.sizes == (4, 1)
    pair, following = windows.features(stretch)
    # The last row's s and a, then the earlier row's change and action.
    np.testing.assert_allclose(pair, [[1.0, 0.1, 0.25, 0.05], [6.0, 0.2, 0.75, 0.15]], rtol=1e-6)
    np.testing.assert_allclose(following, [[1.0], [1.0]])


@pytest.mark.parametrize("make", [Scaling.standardised, Scaling.raw])
def test_a_window_of_one_row_is_that_row(make):
    scaling = make(ROWS)
    stretch = logged_stretch(ROWS, np.arange(4), 1)
    for found, wanted in zip(WindowScaling.of(scaling, stretch).features(stretch), scaling.features(ROWS), strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_a_rollouts_windows_break_where_it_starts_again():
    rolled = rolled_stretch(walk([0.0, 1.0, 3.0, 6.0], [0.1, 0.2, 0.3]), 2)
    np.testing.assert_array_equal(rolled[0][..., 0], [[0.0, 1.0], [1.0, 3.0]])
    ended = np.array([[False, False], [True, False], [False, False]])
    valid = np.array([[True, False], [True, True], [True, True]])
    np.testing.assert_array_equal(unbroken(valid, ended, 2), [[True, False], [False, True]])
    # An end in the last row of a window is part of it.
    np.testing.assert_array_equal(unbroken(valid, ended, 3), [[False, False]])
    np.testing.assert_array_equal(unbroken(valid, ended, 1), valid)
