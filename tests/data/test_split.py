from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc.data.dataset import Dataset
from madoc.data.split import episodes_of, hold_out
from madoc.errors import MadocError
from madoc.types import Transitions

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
