import jax
import numpy as np
import pytest
from layouts import make_dataset

from madoc.errors import MadocError
from madoc.identification.windows import (
    consecutive_rows,
    disjoint_windows,
    drawn,
    evenly,
    first_rows,
    interleaved,
    longest_fit,
    readings_at,
    rows_that_fit,
    successive_windows,
    windows_at,
)


def test_windows_never_cross_the_end_of_an_episode(hopper):
    dataset = make_dataset(hopper, lengths=(3, 1, 4), falls=())
    np.testing.assert_array_equal(first_rows(dataset, np.arange(8), 3), [0, 4, 5])
    np.testing.assert_array_equal(first_rows(dataset, np.arange(8), 1), np.arange(8))


def test_windows_begin_only_where_a_state_can_be_rebuilt(hopper):
    dataset = make_dataset(hopper, lengths=(3, 4), falls=())
    rows = np.array([1, 3, 6])
    np.testing.assert_array_equal(rows[first_rows(dataset, rows, 2)], [1, 3])


def test_a_window_holds_what_was_done_and_seen(hopper):
    dataset = make_dataset(hopper, lengths=(3, 4), falls=())
    states = np.zeros((2, 12))
    windows = windows_at(dataset, states, np.array([0, 4]), 2)
    assert len(windows) == windows.steps == 2
    np.testing.assert_array_equal(windows.actions[1], dataset.transitions.action[4:6])
    np.testing.assert_array_equal(windows.following[0], dataset.transitions.next_observation[:2])


def test_episodes_that_are_too_short_are_refused(hopper):
    dataset = make_dataset(hopper, lengths=(3, 4), falls=())
    with pytest.raises(MadocError, match=r"no stretch of 5 rows .* whose longest episode has 4 rows"):
        first_rows(dataset, np.arange(7), 5)
    assert not len(rows_that_fit(dataset, np.arange(7), 5))


def test_windows_apart_share_no_reading(hopper):
    dataset = make_dataset(hopper, lengths=(6, 4), falls=())
    # Of two rows each, three readings: 0-2, 3-5, and, as another episode shares none with it, from its first row.
    np.testing.assert_array_equal(disjoint_windows(dataset, np.arange(10), 2), [0, 3, 6])
    rows = np.array([1, 2, 4, 7])
    np.testing.assert_array_equal(rows[disjoint_windows(dataset, rows, 2)], [1, 4, 7])


def test_readings_include_the_first(hopper):
    dataset = make_dataset(hopper, lengths=(3, 4), falls=())
    found = readings_at(dataset, np.array([0, 4]), 2)
    assert found.shape == (2, 3, 11)
    np.testing.assert_array_equal(found[:, 0], dataset.transitions.observation[[0, 4]])
    np.testing.assert_array_equal(found[1, 1:], dataset.transitions.next_observation[4:6])


def test_interleaved_windows_have_the_same_share_in_every_stretch():
    mixed = interleaved(np.arange(4), np.arange(10, 22))
    assert sorted(mixed) == [*range(4), *range(10, 22)]
    assert [(mixed[at : at + 4] < 10).sum() for at in (0, 4, 8, 12)] == [1, 1, 1, 1]
    assert interleaved(np.arange(3), np.arange(0)).tolist() == [0, 1, 2]


def test_windows_are_spread_evenly():
    assert evenly(np.arange(10), 4).tolist() == [0, 3, 6, 9]
    assert evenly(np.arange(3), 4).tolist() == [0, 1, 2]


def test_consecutive_rows_lie_in_one_episode(hopper):
    dataset = make_dataset(hopper, lengths=(4, 4), falls=())
    assert consecutive_rows(dataset, np.arange(8)).tolist() == [0, 1, 2, 4, 5, 6]
    assert consecutive_rows(dataset, np.array([0, 2, 3, 4])).tolist() == [1]
    assert not len(consecutive_rows(make_dataset(hopper, lengths=(1, 1, 1), falls=()), np.arange(3)))


def test_successive_windows_cover_the_log(hopper):
    dataset = make_dataset(hopper, lengths=(5, 2), falls=())
    positions, lengths = successive_windows(dataset, np.arange(7), 3)
    assert (positions.tolist(), lengths.tolist()) == ([0, 3, 5], [3, 2, 2])


def test_a_margin_keeps_rows_before_and_behind_a_window(hopper):
    dataset = make_dataset(hopper, lengths=(5, 4), falls=())
    assert rows_that_fit(dataset, np.arange(9), 2, margin=1).tolist() == [1, 2, 6]
    assert longest_fit(dataset, np.array([1, 6]), 9) == 4


def test_drawn_positions_are_ascending_and_at_most_as_many():
    positions = drawn(np.arange(10, 20), 4, jax.random.key(0))
    assert len(set(positions.tolist())) == 4
    assert (np.diff(positions) > 0).all()
