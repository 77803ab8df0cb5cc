import jax
import numpy as np
import pytest

from madoc.learning.features import (
    LoggedFeatures,
    Scaling,
    WindowScaling,
    change_of_motion,
    last_rows,
    unbroken,
    windows_ending,
)
from madoc.types import Transitions
from robots import SPRING_TRUTH, recorded, spring


def rows(observation, action, next_observation):
    observation = np.asarray(observation, np.float64)
    zero, never = np.zeros(observation.shape[:-1]), np.zeros(observation.shape[:-1], bool)
    return Transitions(
        observation, np.asarray(action, np.float64), zero, np.asarray(next_observation, np.float64), never, never
    )


def walk(places, actions):
    """Rows of one channel that go on from each other."""
    places, actions = np.asarray(places, np.float64)[:, None], np.asarray(actions, np.float64)[:, None]
    zero, never = np.zeros(len(actions)), np.zeros(len(actions), bool)
    return Transitions(places[:-1], actions, zero, places[1:], never, never)


ROWS = walk([0.0, 1.0, 3.0, 6.0, 10.0], [0.1, 0.2, 0.3, 0.4])


def test_windows_end_in_rows_of_their_own_episode():
    log = recorded(spring(max_episode_steps=4), SPRING_TRUTH, 6, jax.random.key(0))
    np.testing.assert_array_equal(log.episode_starts, [0, 4])
    np.testing.assert_array_equal(last_rows(log, 3), [2, 3])
    np.testing.assert_array_equal(last_rows(log, 1), np.arange(6))


def test_a_clone_learns_from_as_many_earlier_rows_as_it_will_recall():
    log = recorded(spring(max_episode_steps=4), SPRING_TRUTH, 6, jax.random.key(0))
    features, rows = LoggedFeatures(log), log.transitions
    seen, action = features.pairs()
    np.testing.assert_allclose(seen, rows.observation, rtol=1e-6)
    np.testing.assert_allclose(action, rows.action, rtol=1e-6)
    step = np.concatenate([rows.next_observation - rows.observation, rows.action], axis=1)
    none = np.zeros(3)
    one = np.stack([none, step[0], step[1], step[2], none, step[4]])  # the second episode begins with the fifth row
    two = np.stack([none, none, step[0], step[1], none, none])
    recalled = features.pairs(2)[0]
    np.testing.assert_allclose(recalled, np.concatenate([rows.observation, one, two], axis=1), rtol=1e-4, atol=1e-7)


def test_a_window_holds_the_rows_up_to_its_last():
    windows = windows_ending(ROWS, np.array([1, 3]), 2)
    np.testing.assert_array_equal(windows.observation[..., 0], [[0.0, 3.0], [1.0, 6.0]])
    np.testing.assert_array_equal(windows.action[..., 0], [[0.1, 0.3], [0.2, 0.4]])
    np.testing.assert_array_equal(windows.next_observation[..., 0], [[1.0, 6.0], [3.0, 10.0]])


def test_features_by_hand():
    # Offsets 0, scales 1, 2 (s, a) and 4 (s' - s); the change of motion of both windows is 1, constant: scale 1.
    scaling = Scaling(np.zeros(2), np.array([1.0, 2.0]), np.array([4.0]), difference=True)
    stretch = windows_ending(ROWS, np.array([1, 3]), 2)
    np.testing.assert_array_equal(change_of_motion(stretch)[:, 0], [1.0, 1.0])
    windows = WindowScaling.of(scaling, stretch)
    assert windows.sizes == (4, 1)
    pair, following = windows.features(stretch)
    # The last row's s and a, then the earlier row's change and action.
    np.testing.assert_allclose(pair, [[1.0, 0.1, 0.25, 0.05], [6.0, 0.2, 0.75, 0.15]], rtol=1e-6)
    np.testing.assert_allclose(following, [[1.0], [1.0]])


@pytest.mark.parametrize("make", [Scaling.standardised, Scaling.raw])
def test_a_window_of_one_row_is_that_row(make):
    scaling = make(ROWS)
    stretch = windows_ending(ROWS, np.arange(4), 1)
    for features, expected in zip(
        WindowScaling.of(scaling, stretch).features(stretch), scaling.features(ROWS), strict=True
    ):
        np.testing.assert_array_equal(features, expected)


def test_a_rollouts_windows_break_where_it_starts_again():
    ended = np.array([[False, False], [True, False], [False, False]])
    valid = np.array([[True, False], [True, True], [True, True]])
    np.testing.assert_array_equal(unbroken(valid, ended, 2), [[True, False], [False, True]])
    # An end in the last row of a window is part of it.
    np.testing.assert_array_equal(unbroken(valid, ended, 3), [[False, False]])
    np.testing.assert_array_equal(unbroken(valid, ended, 1), valid)


def test_standardised_scaling_by_hand():
    # s: 1, 3 (mean 2, spread 1); a: 5, 5 (never moves: spread 1); s' - s: 2, 6 (spread 2)
    scaling = Scaling.standardised(rows([[1], [3]], [[5], [5]], [[3], [9]]))
    pair, following = scaling.features(rows([[1], [3], [4]], [[5], [5], [7]], [[3], [9], [4]]))
    np.testing.assert_allclose(pair, [[-1, 0], [1, 0], [2, 2]])
    np.testing.assert_allclose(following, [[1], [3], [0]])
    assert pair.dtype == following.dtype == np.float32


def test_raw_scaling_leaves_rows_as_they_are():
    seen = rows([[1, -2], [3, 4]], [[5], [6]], [[7, 8], [9, 10]])
    pair, following = Scaling.raw(seen).features(seen)
    np.testing.assert_array_equal(pair, [[1, -2, 5], [3, 4, 6]])
    np.testing.assert_array_equal(following, [[7, 8], [9, 10]])


def test_standardised_features_are_of_order_one():
    random = np.random.default_rng(0)
    observation, action = random.normal(5, 20, (1000, 3)), random.normal(size=(1000, 2))
    seen = rows(observation, action, observation + random.normal(0, 1e-3, (1000, 3)))
    pair, following = Scaling.standardised(seen).features(seen)
    np.testing.assert_allclose(pair.mean(0), 0, atol=1e-5)
    np.testing.assert_allclose(pair.std(0), 1, rtol=1e-4)
    np.testing.assert_allclose(following.std(0), 1, rtol=1e-4)


def test_small_changes_of_large_values_survive_float32():
    # in float32, 1e6 + 0.01 is 1e6: the difference has to be taken before
    seen = rows([[1e6], [1e6]], np.zeros((2, 1)), [[1e6 + 0.01], [1e6 - 0.01]])
    _, following = Scaling.standardised(seen).features(seen)
    np.testing.assert_allclose(following, [[1], [-1]], rtol=1e-5)


def test_features_take_any_leading_axes():
    random = np.random.default_rng(0)
    seen = rows(random.normal(size=(4, 5, 3)), random.normal(size=(4, 5, 2)), random.normal(size=(4, 5, 3)))
    flat = rows(*(part.reshape(20, -1) for part in (seen.observation, seen.action, seen.next_observation)))
    scaling = Scaling.standardised(flat)
    for shaped, straight in zip(scaling.features(seen), scaling.features(flat), strict=True):
        assert shaped.shape[:2] == (4, 5)
        np.testing.assert_array_equal(shaped.reshape(20, -1), straight)


def test_raw_features_of_the_next_state_become_those_of_its_change():
    window = rows([[1.0, 2.0], [3.0, 5.0]], [[0.5], [0.5]], [[3.0, 5.0], [7.0, 7.0]])
    scaling = WindowScaling(Scaling.raw(window), 2, np.ones(2))
    np.testing.assert_array_equal(scaling.changes(*scaling.features(window)), [4.0, 2.0])
