"""Episodes of a spec: goals drawn once and kept, starts, ends and rewards worked by hand."""

import jax
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.simulation.rollout import reset_states
from own_robots import CART_SPEC, write_robot

EPISODE = """\
goals:
  - {name: wanted, drawn: "uniform(1, 3)"}
  - {name: beyond, drawn: wanted + 0.5}
reward: where(abs(place - wanted) < 0.1, 1, -abs(place - wanted)) - 0.1 * push
end: place > beyond or velocity(rail) < -5
reset: {position(rail): "normal(0, 1) * 0 + wanted - 2", velocity(rail): 0.25}
"""

KEY = jax.random.key(0)


@pytest.fixture
def task(tmp_path):
    return robots.load(write_robot(tmp_path, CART_SPEC + EPISODE)).task


def test_a_log_of_the_robot_knows_no_goals(task):
    assert (task.observation_size, task.goals, task.signals) == (2, (), ("place", "speed"))
    assert simulation.make(task).initial_state.tolist() == [0.0, 0.0]
    assert task.reward(np.ones((3, 2)), np.ones((3, 1)), np.ones((3, 2))).tolist() == [0.0, 0.0, 0.0]
    assert task.rewarded
    fewer = task.with_parameters(["body_mass.cart"])
    assert fewer.for_policies.parameters == fewer.parameters


def test_goals_are_drawn_at_a_reset_and_hold(task):
    learnt = task.for_policies
    assert (learnt.observation_size, learnt.signals) == (4, ("place", "speed", "wanted", "beyond"))
    simulator = simulation.make(learnt)
    start = reset_states(simulator)(KEY, 1000)
    place, speed, wanted, beyond = start.T
    assert (wanted.min() > 1.0) & (wanted.max() < 3.0) & (abs(wanted.mean() - 2.0) < 0.1)
    np.testing.assert_allclose(beyond, wanted + 0.5, rtol=1e-6)
    np.testing.assert_allclose(place, wanted - 2.0, atol=1e-6)
    assert (speed == 0.25).all()
    system = simulator.bind({"body_mass.cart": 2.0})
    after = system.step(start[None], np.ones((1, 1000, 1)))
    assert (after[..., 2:] == start[:, 2:]).all()
    # 10 N on 2 kg for 0.02 s.
    np.testing.assert_allclose(after[0, :, 1], 0.25 + 0.1, rtol=1e-9)
    assert (system.observe(after) == after).all()


def test_rewards_and_ends(task):
    learnt = task.for_policies
    following = np.array([[2.0, 0.0, 2.05, 2.5], [3.0, 0.0, 2.0, 2.5], [0.0, -6.0, 2.0, 2.5]])
    reward = learnt.reward(0 * following, np.array([[0.5], [0.0], [-1.0]]), following)
    np.testing.assert_allclose(reward, [1.0 - 0.5, -1.0, -2.0 + 1.0])
    assert learnt.terminated(following).tolist() == [False, True, True]


def test_goals_stand_behind_pending_actions(tmp_path):
    spec = CART_SPEC + "  - {field: action_delay, low: 0, high: 0.02}\n" + EPISODE
    simulator = simulation.make(robots.load(write_robot(tmp_path, spec)).task.for_policies)
    start = reset_states(simulator)(KEY, 1)
    assert start.shape == (1, 5)
    system = simulator.bind({"body_mass.cart": 2.0, "action_delay": 0.02})
    after = system.step(start[None], np.full((1, 1, 1), 0.5))[0, 0]
    np.testing.assert_array_equal(after[2:], [0.5, *start[0, 3:]])
    assert after[1] == 0.25
