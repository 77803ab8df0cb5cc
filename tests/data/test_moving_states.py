from dataclasses import replace

import jax
import numpy as np
import pytest
from layouts import make_dataset

from madoc import robots, tasks
from madoc.data import Disturbance, disturb, hide_velocities, observed_task
from madoc.data.velocities import moving_states, show_velocities
from madoc.errors import MadocError
from own_robots import ARM_SPEC, write_robot
from robots import two_link_arm

DIFFERENCES = Disturbance(velocities="differences")
KEY = jax.random.key(0)
STEP = 0.02
"""s, a control step of the arm."""


@pytest.fixture
def encoders(tmp_path):
    """The arm, of which only the shoulder's speed is measured."""
    hidden = ARM_SPEC.replace("  - {name: elbow_speed, reads: velocity(elbow)}\n", "")
    return robots.load(write_robot(tmp_path, hidden)).task


def thrown(task, columns, lengths=(3, 2)):
    """Episodes at constant acceleration: the angle after t steps is t²; row by row, as logs are."""
    made = make_dataset(task, lengths=lengths, falls=())
    time = np.concatenate([np.arange(length) for length in lengths])
    here, there = (np.repeat((when**2.0)[:, None], columns, axis=1) for when in (time, time + 1))
    return replace(made, transitions=replace(made.transitions, observation=here, next_observation=there))


def test_differences_span_two_steps_and_one_at_the_ends_of_an_episode(hidden_arm):
    before, after = moving_states(thrown(hidden_arm, 2), hidden_arm)
    # Angles 0, 1, 4, 9 and 0, 1, 4: from start (1 - 0), (4 - 0) / 2, (9 - 1) / 2, and at the end (9 - 4).
    np.testing.assert_allclose(before[:, 2] * STEP, [1.0, 2.0, 4.0, 1.0, 2.0])
    np.testing.assert_allclose(after[:, 3] * STEP, [2.0, 4.0, 5.0, 2.0, 3.0])
    np.testing.assert_array_equal(before[:, 0], [0.0, 1.0, 4.0, 0.0, 1.0])


@pytest.fixture
def hidden_arm():
    return hide_velocities(replace(two_link_arm(), velocities=2))


def test_velocities_that_are_measured_stay(encoders):
    log = thrown(encoders, 3)
    measured, differences = moving_states(log, encoders)[0][:, 2:].T
    np.testing.assert_array_equal(measured, log.transitions.observation[:, 2])
    np.testing.assert_allclose(differences * STEP, [1.0, 2.0, 4.0, 1.0, 2.0])


def test_differences_are_put_in_where_a_robot_measures_none(encoders):
    filled = disturb(thrown(encoders, 3), DIFFERENCES, encoders, KEY)
    np.testing.assert_allclose(filled.transitions.observation[:, 3] * STEP, [1.0, 2.0, 4.0, 1.0, 2.0])
    np.testing.assert_allclose(filled.transitions.next_observation[:, 3] * STEP, [2.0, 4.0, 5.0, 2.0, 3.0])
    task = observed_task(encoders, filled)
    assert task.observation_size == 4
    assert task.signals[3] == "velocity(elbow)"
    state = np.random.default_rng(0).normal(size=(5, 4))
    np.testing.assert_allclose(task.state_from_observation(task.observe(state)), state)
    assert any("differences of positions" in sentence for sentence in filled.disturbance.sentences())


def test_differences_take_the_place_of_hidden_velocities():
    whole = replace(two_link_arm(), velocities=2)
    filled = disturb(thrown(whole, 4), Disturbance(hidden_velocities=True, velocities="differences"), whole, KEY)
    np.testing.assert_allclose(filled.transitions.observation[:, 3] * STEP, [1.0, 2.0, 4.0, 1.0, 2.0])
    assert observed_task(whole, filled) is whole


def test_velocities_are_not_replaced_where_they_are_measured():
    whole = replace(two_link_arm(), velocities=2)
    with pytest.raises(MadocError, match="has velocities; velocities=differences is for data without"):
        disturb(thrown(whole, 4), DIFFERENCES, whole, KEY)


def test_positions_that_are_not_seen_have_no_velocities():
    hopper = tasks.make("hopper")
    hidden = Disturbance(hidden_velocities=True, velocities="differences")
    with pytest.raises(MadocError, match="does not show the position of rootx"):
        disturb(make_dataset(hopper, lengths=(3, 4), falls=()), hidden, hopper, KEY)


def test_a_robot_that_shows_no_position_is_refused():
    blind = replace(two_link_arm(), state_from_observation=None)
    with pytest.raises(MadocError, match="determines none of its positions"):
        moving_states(thrown(blind, 4), blind)
    with pytest.raises(MadocError, match="determines none of its positions"):
        show_velocities(blind)
