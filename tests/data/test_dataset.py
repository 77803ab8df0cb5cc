"""Datasets: subsamples, episodes that are closed, taken and split, hold-outs, and time scales."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from layouts import make_dataset, with_fields

from madoc.data import Disturbance, stride, subsample, typical_change
from madoc.data.dataset import Dataset, close_episodes, episodes_of, hold_out, starts_after
from madoc.errors import MadocError
from madoc.identification.states import logged_states
from madoc.types import Transitions


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


KEY = jax.random.key(0)


def log(*lengths):
    """Rows numbered by their observation, in episodes of the given lengths."""
    rows = np.arange(sum(lengths), dtype=np.float64)
    ends = np.zeros(len(rows), bool)
    ends[np.cumsum(lengths) - 1] = True
    flat = Transitions(
        rows[:, None], np.zeros((len(rows), 1)), rows, rows[:, None] + 1, np.zeros(len(rows), bool), ends
    )
    return Dataset(flat, np.cumsum([0, *lengths[:-1]]), "spring", "modern", "a test")


def numbers(dataset):
    return dataset.transitions.observation[:, 0].astype(int).tolist()


@pytest.mark.parametrize("lengths", [(10,) * 10, (3, 50, 7, 7, 33), (1,) * 40, (5, 90), (90, 5), (50,) * 30])
@pytest.mark.parametrize("share", [0.05, 0.2, 0.5, 0.95])
def test_whole_episodes_on_both_sides_and_every_row_on_one(lengths, share):
    whole = log(*lengths)
    split = hold_out(whole, share, KEY)
    assert sorted(numbers(split.kept) + numbers(split.held)) == numbers(whole)
    starts, ends = whole.episode_starts, whole.episode_ends
    episodes = {tuple(range(start, end)) for start, end in zip(starts, ends, strict=True)}
    for part in (split.kept, split.held):
        rows = numbers(part)
        mine = [tuple(rows[a:b]) for a, b in zip(part.episode_starts, part.episode_ends, strict=True)]
        assert mine
        assert set(mine) <= episodes


def test_the_share_is_met_where_episodes_allow_it():
    split = hold_out(log(*(10,) * 10), 0.2, KEY)
    assert len(split.held) == 20
    assert split.sentence == "2 of 10 episodes are held out, 20 of 100 rows"


def test_another_seed_holds_out_others_and_the_same_seed_the_same():
    whole = log(*(10,) * 20)
    first, again, other = (hold_out(whole, 0.2, jax.random.key(seed)) for seed in (1, 1, 2))
    assert numbers(first.held) == numbers(again.held) != numbers(other.held)


def test_one_episode_is_cut_and_says_so():
    split = hold_out(log(10), 0.2, KEY)
    assert (numbers(split.kept), numbers(split.held)) == (list(range(8)), [8, 9])
    assert split.kept.transitions.truncated[-1]
    assert "only one episode" in split.sentence


def test_stretches_of_one_long_episode_are_held_out():
    whole = log(1000)
    split = hold_out(whole, 0.2, KEY)
    assert sorted(numbers(split.kept) + numbers(split.held)) == numbers(whole)
    assert len(split.held) == 200
    assert split.sentence.startswith("2 of 10 stretches are held out, 200 of 1,000 rows: the only episode is cut")
    for part in (split.kept, split.held):
        for start, end in zip(part.episode_starts, part.episode_ends, strict=True):
            rows = numbers(part)[start:end]
            assert len(rows) == 100
            assert rows[0] % 100 == 0
            assert part.transitions.truncated[end - 1]
    assert numbers(split.held) != numbers(hold_out(whole, 0.2, jax.random.key(1)).held)


@pytest.mark.parametrize("lengths", [(5000, 30), (30, 5000), (990, 10), (500, 500), (1000, 1000, 10)])
def test_uneven_episodes_are_cut_until_the_share_is_near(lengths):
    whole = log(*lengths)
    split = hold_out(whole, 0.2, KEY)
    assert sorted(numbers(split.kept) + numbers(split.held)) == numbers(whole)
    assert 0.1 * len(whole) <= len(split.held) <= 0.4 * len(whole)
    assert "long episodes are cut" in split.sentence
    for part in (split.kept, split.held):
        rows = np.array(numbers(part))
        for start, end in zip(part.episode_starts, part.episode_ends, strict=True):
            assert (np.diff(rows[start:end]) == 1).all()


def test_names_of_runs_go_with_them():
    whole = replace(log(*(10,) * 10), run_names=tuple("abcdefghij"))
    split = hold_out(whole, 0.2, KEY)
    for part in (split.kept, split.held):
        assert [whole.run_names[row // 10] for row in numbers(part)[::10]] == list(part.run_names)


def test_two_rows_leave_one_on_each_side():
    split = hold_out(log(2), 0.01, KEY)
    assert (numbers(split.kept), numbers(split.held)) == ([0], [1])


def test_what_cannot_be_held_out_is_refused():
    with pytest.raises(MadocError, match="between 0 and 1, got 1"):
        hold_out(log(5, 5), 1.0, KEY)
    with pytest.raises(MadocError, match="at least 2 rows"):
        hold_out(log(1), 0.2, KEY)


def test_episodes_in_the_order_given():
    part = episodes_of(log(2, 3, 1), np.array([2, 0]))
    assert (numbers(part), part.episode_starts.tolist()) == ([5, 0, 1], [0, 1])


def test_a_dataset_splits_itself():
    whole = log(*(10,) * 10)
    train, held_out = whole.split(0.2)
    assert (len(train), len(held_out)) == (80, 20)
    assert numbers(held_out) == numbers(whole.split(0.2)[1])
    parts = hold_out(whole, 0.3, jax.random.key(4))
    assert [numbers(part) for part in whole.split(0.3, key=jax.random.key(4))] == [
        numbers(parts.kept),
        numbers(parts.held),
    ]


PERIOD = 2.0
"""Of the oscillation in s; its mean squared change reaches its variance after a sixth of it, as 2 (1 - cos φ) = 1."""


def swinging(rate: float, *, noise: float = 0.0, seconds: float = 40.0, episodes: int = 2) -> Dataset:
    """An oscillation of amplitude 1 logged at a rate in Hz, in episodes."""
    count = round(seconds * rate) + 1
    angle = np.sin(2.0 * np.pi / PERIOD * np.arange(count) / rate)
    angle = angle + noise * np.random.default_rng(0).standard_normal(count)
    rows = count - 1
    ends = np.zeros(rows, dtype=bool)
    starts = np.linspace(0, rows, episodes, endpoint=False).astype(np.int64)
    ends[np.append(starts, rows)[1:] - 1] = True
    quiet = np.zeros(rows)
    transitions = Transitions(angle[:-1, None], quiet[:, None], quiet, angle[1:, None], ~np.ones(rows, bool), ends)
    return Dataset(transitions, starts, "swing", "modern", "a test")


@pytest.mark.parametrize(("rate", "noise"), [(30.0, 0.0), (300.0, 0.0), (300.0, 0.05)])
def test_the_time_scale_depends_neither_on_the_rate_nor_on_noise(rate: float, noise: float) -> None:
    log = swinging(rate, noise=noise)
    assert log.time_scale / rate == pytest.approx(PERIOD / 6.0, rel=0.05, abs=1.1 / rate)


def test_the_time_scale_of_a_long_log_is_that_of_all_of_it() -> None:
    """At 500 Hz the robot rests for 44 s, which are 22,000 rows, and swings for as long; lags are 11 % apart."""
    log = swinging(500.0, seconds=88.0)
    half = log.episode_starts[1]
    angle, following = (np.array(part) for part in (log.transitions.observation, log.transitions.next_observation))
    angle[:half], following[:half] = 0.0, 0.0
    rested = replace(log, transitions=replace(log.transitions, observation=angle, next_observation=following))
    assert rested.time_scale / 500.0 == pytest.approx(PERIOD / 6.0, rel=0.11)


def test_a_motion_whose_period_is_that_of_thinned_rows_is_seen_in_all_of_its_poses() -> None:
    """At 10 Hz a period is twenty rows, of which one is compared: 1 - cos φ is 0.41 after three rows, 0.69 after four.

    From the first of every twenty rows alone the angle has changed by sin φ, whose square is 0.65 after three.
    """
    assert swinging(10.0, seconds=40_000.0, episodes=1).time_scale == 4


def test_a_stride_is_a_twentieth_of_it_and_a_row_at_least() -> None:
    assert (stride(swinging(30.0)), stride(swinging(300.0))) == (1, 5)
    lost = replace(swinging(300.0), disturbance=Disturbance(shuffled="rows"))
    assert (lost.time_scale, stride(lost)) == (1, 1)


def test_a_typical_change_is_that_of_a_stride() -> None:
    # a sine changes by 2 sin(π / 60) cos(...) in a 60th of its period: the root mean square of that
    expected = 2.0 * np.sin(np.pi * 5.0 / 600.0) / np.sqrt(2.0)
    assert typical_change(swinging(300.0)) == pytest.approx([expected], rel=0.02)
