from dataclasses import replace

import jax
import numpy as np
import pytest
from layouts import make_dataset, with_fields

from madoc.data import subsample
from madoc.data.dataset import close_episodes, starts_after
from madoc.errors import MadocError
from madoc.identification.states import logged_states


def rewards(dataset):
    """A row's reward is its row number in `make_dataset`: which rows were kept."""
    return dataset.transitions.reward.astype(int)


def test_starts_after_the_rows_that_end_an_episode():
    np.testing.assert_array_equal(starts_after(np.array([0, 1, 0, 1], dtype=bool)), [0, 2])


def test_a_record_that_ends_without_a_fall_is_truncated(hopper):
    dataset = make_dataset(hopper, lengths=(2, 2), falls=(1,))
    rows = replace(dataset.transitions, truncated=np.zeros(4, dtype=bool))
    np.testing.assert_array_equal(close_episodes(rows, dataset.episode_starts).truncated, [0, 1, 0, 0])
    assert not rows.truncated.any()


@pytest.mark.parametrize("count", range(1, 14))
def test_subsample_takes_whole_episodes_and_cuts_the_last_short(hopper, count):
    dataset = make_dataset(hopper)
    drawn = subsample(dataset, count, jax.random.key(3))
    assert len(drawn) == count
    lengths = dict(zip(dataset.episode_starts, dataset.episode_ends - dataset.episode_starts, strict=True))
    spans = list(zip(drawn.episode_starts, drawn.episode_ends, strict=True))
    for number, (start, end) in enumerate(spans):
        kept = rewards(drawn)[start:end]
        np.testing.assert_array_equal(kept, np.arange(kept[0], kept[0] + len(kept)))
        last = number == len(spans) - 1
        assert len(kept) <= lengths[kept[0]] if last else len(kept) == lengths[kept[0]]
    ends = drawn.episode_ends - 1
    assert (drawn.transitions.terminated | drawn.transitions.truncated)[ends].all()


def test_subsample_depends_on_the_key_only_and_smaller_is_a_prefix(hopper):
    dataset = make_dataset(hopper, lengths=(3,) * 20)
    one = subsample(dataset, 20, jax.random.key(1))
    np.testing.assert_array_equal(rewards(one), rewards(subsample(dataset, 20, jax.random.key(1))))
    np.testing.assert_array_equal(rewards(one)[:7], rewards(subsample(dataset, 7, jax.random.key(1))))
    assert (rewards(one) != rewards(subsample(dataset, 20, jax.random.key(2)))).any()


def test_subsample_marks_the_cut_and_keeps_everything_else(hopper):
    dataset = replace(make_dataset(hopper, lengths=(9,), falls=()), true_parameters={"gravity": -9.81})
    drawn = subsample(dataset, 4, jax.random.key(0))
    np.testing.assert_array_equal(drawn.transitions.truncated, [0, 0, 0, 1])
    assert drawn.true_parameters == {"gravity": -9.81}
    assert drawn.origin == dataset.origin
    assert not dataset.transitions.truncated[3]


def test_subsample_of_more_than_there_is_changes_nothing(hopper):
    dataset = make_dataset(hopper)
    assert subsample(dataset, len(dataset), jax.random.key(0)) is dataset


def test_subsample_refuses_nothing(hopper):
    with pytest.raises(MadocError, match="max_transitions of at least 1, got 0"):
        subsample(make_dataset(hopper), 0, jax.random.key(0))


def test_logged_states_leave_out_rows_with_a_clipped_velocity(hopper):
    dataset = make_dataset(hopper)
    observation = dataset.transitions.observation.copy()
    observation[2, 7] = 10.0
    observation[5, 10] = -10.0
    states, rows = logged_states(with_fields(dataset, observation=observation), hopper)
    np.testing.assert_array_equal(rows, np.setdiff1d(np.arange(len(dataset)), [2, 5]))
    np.testing.assert_array_equal(states, np.pad(observation[rows], ((0, 0), (1, 0))))
    assert states.dtype == np.float64


def test_logged_states_of_every_row_where_nothing_says_otherwise(hopper):
    dataset = make_dataset(hopper)
    _, rows = logged_states(dataset, replace(hopper, rebuildable=None))
    assert len(rows) == len(dataset)


def test_logged_states_refuse_what_cannot_be_rebuilt(hopper):
    dataset = make_dataset(hopper)
    with pytest.raises(MadocError, match="an observation of hopper does not determine its state"):
        logged_states(dataset, replace(hopper, state_from_observation=None))
    clipped = with_fields(dataset, observation=np.full_like(dataset.transitions.observation, 10.0))
    with pytest.raises(MadocError, match=r"none of the 14 logged states of hopper can be rebuilt .* made by a"):
        logged_states(clipped, hopper)
