from dataclasses import replace

import numpy as np
import pytest
from layouts import make_dataset, with_fields

from madoc.data import validate
from madoc.data.validation import as_flags, as_matrix, as_vector
from madoc.errors import MadocError


def changed(values, place, value):
    values = values.copy()
    values[place] = value
    return values


def test_a_good_dataset_passes_unchanged(hopper):
    dataset = make_dataset(hopper)
    np.testing.assert_array_equal(validate(dataset, hopper).transitions.action, dataset.transitions.action)


def test_another_robot_is_refused(hopper, ant):
    with pytest.raises(MadocError, match="expected data of ant, got data of hopper in made by a test"):
        validate(make_dataset(hopper), ant)


def test_no_rows_are_refused(hopper):
    dataset = make_dataset(hopper)
    empty = replace(dataset, transitions=dataset.transitions.take(np.arange(0)), episode_starts=np.arange(0))
    with pytest.raises(MadocError, match="at least one transition for hopper, got none in made by a test"):
        validate(empty, hopper)


@pytest.mark.parametrize(
    ("width", "sentence"),
    [
        (12, "expected 11 values per observation for hopper, got 12 in row 0 of obs; a NeoRL file"),
        (17, "expected 11 values per observation for hopper, got 17 in row 0 of obs; is this file of hopper"),
    ],
)
def test_a_wrong_observation_width_is_refused(hopper, width, sentence):
    dataset = with_fields(make_dataset(hopper), observation=np.zeros((14, width)))
    names = {name: name for name in vars(dataset.transitions)} | {"observation": "obs"}
    with pytest.raises(MadocError, match=sentence):
        validate(dataset, hopper, names)


def test_a_wrong_action_width_is_refused(hopper):
    with pytest.raises(MadocError, match="expected 3 values per action for hopper, got 6 in row 0 of action"):
        validate(with_fields(make_dataset(hopper), action=np.zeros((14, 6))), hopper)


@pytest.mark.parametrize("field", ["observation", "action", "next_observation"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_value_that_is_not_finite_is_refused(hopper, field, value):
    dataset = make_dataset(hopper)
    values = changed(getattr(dataset.transitions, field), ([5, 9], 1), value)
    with pytest.raises(MadocError, match=rf"got {value} in row 5 of {field} \(2 such rows\)"):
        validate(with_fields(dataset, **{field: values}), hopper)


def test_a_reward_that_is_not_finite_is_refused(hopper):
    dataset = make_dataset(hopper)
    with pytest.raises(MadocError, match=r"got -inf in row 13 of reward \(1 such rows\)"):
        validate(with_fields(dataset, reward=changed(dataset.transitions.reward, 13, -np.inf)), hopper)


def test_actions_within_rounding_are_clipped_and_others_refused(hopper):
    dataset = make_dataset(hopper)
    rounded = with_fields(dataset, action=changed(dataset.transitions.action, (4, 0), 1.000001))
    assert validate(rounded, hopper).transitions.action[4, 0] == 1.0
    beyond = with_fields(dataset, action=changed(dataset.transitions.action, (4, 0), -1.5))
    with pytest.raises(MadocError, match=r"actions in \[-1, 1\], got one of size 1.5 in row 4 of action .*clip"):
        validate(beyond, hopper)
    assert validate(beyond, hopper, clip_actions=True).transitions.action[4, 0] == -1.0


def test_lengths_that_disagree_are_refused(hopper):
    dataset = with_fields(make_dataset(hopper), reward=np.zeros(13))
    with pytest.raises(MadocError, match="as many rows in reward as in observation, got 13 and 14"):
        validate(dataset, hopper)


@pytest.mark.parametrize("starts", [[], [1, 4], [0, 4, 4], [0, 14]])
def test_wrong_episode_starts_are_refused(hopper, starts):
    with pytest.raises(MadocError, match="ascending episode starts from 0 to below 14"):
        validate(replace(make_dataset(hopper), episode_starts=np.array(starts, dtype=int)), hopper)


def test_arrays_of_the_wrong_kind_are_refused():
    with pytest.raises(MadocError, match="expected numbers in obs, got dtype <U1"):
        as_matrix(np.array([["a"]]), "obs")
    with pytest.raises(MadocError, match=r"expected obs of shape \(rows, values\), got shape \(3,\)"):
        as_matrix(np.zeros(3), "obs")
    with pytest.raises(MadocError, match=r"one value per row in reward, got shape \(3, 2\)"):
        as_vector(np.zeros((3, 2)), "reward")
    with pytest.raises(MadocError, match="expected 0 or 1, got 2 in row 1 of done"):
        as_flags(np.array([[0], [2]]), "done")


def test_a_column_of_one_value_is_a_vector():
    np.testing.assert_array_equal(as_flags(np.array([[0.0], [1.0]]), "done"), [False, True])
