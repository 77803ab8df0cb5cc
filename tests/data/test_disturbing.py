from dataclasses import replace

import jax
import numpy as np
import pytest
from layouts import make_dataset

from madoc import data, tasks
from madoc.data import Disturbance, disturb, hide_velocities, observed_task
from madoc.data.disturbing import noise_of
from madoc.errors import MadocError

KEY = jax.random.key(0)
HIDDEN = Disturbance(hidden_velocities=True)


@pytest.fixture(scope="module")
def dataset(hopper):
    """Two episodes that go on from row to row, as logs do."""
    made = make_dataset(hopper, lengths=(3, 4), falls=())
    observation = np.random.default_rng(0).normal(size=(9, 11))
    before, after = [0, 1, 2, 4, 5, 6, 7], [1, 2, 3, 5, 6, 7, 8]
    rows = replace(made.transitions, observation=observation[before], next_observation=observation[after])
    return replace(made, transitions=rows)


def test_noise_is_a_share_of_each_channels_change(hopper):
    made = make_dataset(hopper, lengths=(2000,), falls=())
    change = np.random.default_rng(0).normal(size=(2000, 11)) * np.arange(11)
    rows = replace(made.transitions, next_observation=made.transitions.observation + change)
    before, after = noise_of(replace(made, transitions=rows), 0.1, KEY)
    for noise in (before, after):
        np.testing.assert_allclose(noise.std(0), 0.1 * np.arange(11), rtol=0.1)
        np.testing.assert_allclose(noise.mean(0), 0.0, atol=0.1)


def test_a_sensor_is_read_once_a_step(dataset, hopper):
    noisy = disturb(dataset, Disturbance(noise=0.1), hopper, KEY).transitions
    assert (noisy.observation != dataset.transitions.observation).all()
    within = [0, 1, 3, 4, 5]
    np.testing.assert_array_equal(noisy.next_observation[within], noisy.observation[1:][within])
    assert (noisy.next_observation[2] != noisy.observation[3]).all()


def test_hidden_velocities_leave_positions(dataset, hopper):
    hidden = disturb(dataset, HIDDEN, hopper, KEY)
    np.testing.assert_array_equal(hidden.transitions.observation, dataset.transitions.observation[:, :5])
    np.testing.assert_array_equal(hidden.transitions.next_observation, dataset.transitions.next_observation[:, :5])
    task = observed_task(hopper, hidden)
    assert task.observation_size == 5
    assert task.state_from_observation is None
    assert observed_task(hopper, dataset) is hopper


@pytest.mark.parametrize("name", tasks.TASKS)
def test_what_is_hidden_are_the_velocities(name):
    task = tasks.make(name)
    model = task.compile()
    state = np.concatenate([np.arange(model.nq), 5.0 + np.zeros(model.nv)])
    shown = hide_velocities(task).observe(state)
    np.testing.assert_array_equal(shown, state[model.nq - len(shown) : model.nq])
    assert len(shown) == hide_velocities(task).observation_size


def test_velocities_that_cannot_be_told_apart_are_not_hidden(dataset, hopper):
    with pytest.raises(MadocError, match="an observation of hopper does not end in velocities"):
        disturb(dataset, HIDDEN, replace(hopper, velocities=0), KEY)


def test_shuffled_rows_stay_whole_and_stand_alone(dataset, hopper):
    shuffled = disturb(dataset, Disturbance(shuffled="rows"), hopper, KEY)
    order = shuffled.transitions.reward.astype(int)
    assert sorted(order) == list(range(7))
    assert (order != np.arange(7)).any()
    for name in ("observation", "action", "next_observation"):
        clean = getattr(dataset.transitions, name)
        np.testing.assert_array_equal(getattr(shuffled.transitions, name), clean[order])
    np.testing.assert_array_equal(shuffled.episode_starts, np.arange(7))
    data.validate(shuffled, hopper)


def test_shuffled_next_observations_lose_their_rows(dataset, hopper):
    shuffled = disturb(dataset, Disturbance(shuffled="next_observations"), hopper, KEY)
    order = shuffled.transitions.reward.astype(int)
    np.testing.assert_array_equal(shuffled.transitions.observation, dataset.transitions.observation[order])
    following = shuffled.transitions.next_observation
    assert (following != dataset.transitions.next_observation[order]).any()
    np.testing.assert_array_equal(np.sort(following, 0), np.sort(dataset.transitions.next_observation, 0))


def test_clean_data_stays_as_it_is(dataset, hopper):
    same = disturb(dataset, Disturbance(), hopper, KEY)
    assert same.transitions is dataset.transitions
    assert same.disturbance.sentences() == ()


def test_the_same_key_disturbs_the_same_way(dataset, hopper):
    first, again, other = (disturb(dataset, Disturbance(noise=0.1), hopper, jax.random.key(k)) for k in (0, 0, 1))
    np.testing.assert_array_equal(first.transitions.observation, again.transitions.observation)
    assert (first.transitions.observation != other.transitions.observation).all()


def test_what_was_disturbed_travels_with_the_file(dataset, hopper, tmp_path):
    asked = Disturbance(noise=0.1, hidden_velocities=True, shuffled="rows")
    told = replace(disturb(dataset, asked, hopper, KEY), disturbance=replace(asked, friction=1.2))
    data.save(told, tmp_path / "log.npz")
    loaded = data.load(tmp_path / "log.npz", hopper)
    assert loaded.disturbance == told.disturbance
    assert len(loaded.disturbance.sentences()) == 4


@pytest.mark.parametrize("asked", [Disturbance(noise=0.1), HIDDEN, Disturbance(shuffled="rows")])
def test_the_same_disturbance_twice_is_refused(dataset, hopper, asked):
    once = disturb(dataset, asked, hopper, KEY)
    with pytest.raises(MadocError, match="already; disturb the clean data instead"):
        disturb(once, asked, hopper, KEY)


@pytest.mark.parametrize("wrong", [{"noise": -0.1}, {"noise": float("nan")}, {"friction": 0.0}])
def test_impossible_disturbances_are_refused(wrong):
    with pytest.raises(MadocError, match=r"expected (noise|friction) as a"):
        Disturbance(**wrong)


def test_a_target_of_more_friction_slides_less(hopper):
    slippery, rough = hopper.compile(), hopper.with_friction(1.2).compile()
    np.testing.assert_allclose(rough.geom_friction[:, 0], 1.2 * slippery.geom_friction[:, 0])
    np.testing.assert_array_equal(rough.geom_friction[:, 1:], slippery.geom_friction[:, 1:])
    assert hopper.compile().geom_friction == pytest.approx(slippery.geom_friction)
