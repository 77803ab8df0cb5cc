"""Late actions: weights worked by hand, and a double integrator under them."""

import numpy as np
import pytest

from madoc.errors import MadocError
from madoc.parameters import Parameter
from madoc.robots import load
from madoc.simulation.cpu import CpuSimulator
from madoc.simulation.delay import action_weights, blend, pending_actions
from own_robots import CART_SPEC, write_robot

STEP = 0.02
DELAY = "  - {field: action_delay, low: 0, high: 0.05}\n"
TWO_CARTS_MODEL = """
<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>
  <body><joint name="left" type="slide"/><geom size="0.1" mass="1"/></body>
  <body pos="0 1 0"><joint name="right" type="slide"/><geom size="0.1" mass="1"/></body>
</worldbody></mujoco>
"""
TWO_CARTS = """
madoc: 1
name: carts
model: carts.xml
control_step: 0.02
signals:
  - {name: left, reads: position(left), unit: m}
  - {name: right, reads: position(right), unit: m}
actions:
  - {name: push_left, joint: left, means: force, low: -1, high: 1, unit: N}
  - {name: push_right, joint: right, means: force, low: -1, high: 1, unit: N}
parameters:
  - {field: action_delay, element: push_left, low: 0, high: 0.04}
  - {field: action_lag, element: push_left, low: 0, high: 0.02}
"""


def weights(delay, physics_steps=2, pending=1, lag=0.0):
    times = np.array([[delay]]), np.array([[lag]])
    return action_weights(*times, control_step=STEP, physics_steps=physics_steps, pending=pending)[0, ..., 0]


@pytest.mark.parametrize(
    ("delay", "expected"),
    [
        (0.0, [[1, 0], [1, 0]]),
        (0.01, [[0, 1], [1, 0]]),
        (0.005, [[0.5, 0.5], [1, 0]]),
        (0.015, [[0, 1], [0.5, 0.5]]),
        (0.02, [[0, 1], [0, 1]]),
    ],
)
def test_within_one_control_step(delay, expected):
    np.testing.assert_allclose(weights(delay), expected, atol=1e-12)


def test_over_several_control_steps():
    # 0.045 s are two control steps and half a physics step: the action of two steps ago takes effect there.
    np.testing.assert_allclose(weights(0.045, pending=3), [[0, 0, 0.5, 0.5], [0, 0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(weights(0.06, pending=3), [[0, 0, 0, 1], [0, 0, 0, 1]], atol=1e-12)


def test_weights_are_shares():
    delays, lags = np.meshgrid(np.linspace(0.0, 0.06, 31), [0.0, 1e-4, 0.01, 0.3])
    times = delays.reshape(-1, 1), lags.reshape(-1, 1)
    found = action_weights(*times, control_step=STEP, physics_steps=5, pending=3)
    np.testing.assert_allclose(found.sum(2), 1.0, atol=1e-12)
    assert (found >= -1e-15).all()


def test_a_lag_follows_by_one_time_constant():
    """Of a command at time 0 it has followed 1 - exp(-t / λ), on average 1 - λ/h (exp(-a / λ) - exp(-b / λ))."""
    found, end = weights(0.0, lag=0.01, pending=2), np.exp(-np.arange(5))
    followed = 1.0 - (end[:-1] - end[1:])
    np.testing.assert_allclose(found[:, 0], followed[:2], atol=1e-12)
    np.testing.assert_allclose(found[:, 1], followed[2:] - followed[:2], atol=1e-12)
    assert (pending_actions(0.03, 0.0, STEP), pending_actions(0.03, 0.02, STEP)) == (2, 8)


def test_one_drive_follows_later_than_the_other(tmp_path):
    """The left drive has a delay and a lag of its own, the right one none."""
    task = load(write_robot(tmp_path, TWO_CARTS, carts=TWO_CARTS_MODEL)).task
    system = CpuSimulator(task, threads=1).bind(np.array([[0.02, 0.0], [0.0, 0.01], [0.0, 0.0]]))
    state = np.zeros((3, 1, 4 + 2 * task.pending))
    after = system.step(state, np.ones((3, 1, 2)))[:, 0]
    assert after[:, 3] == pytest.approx(after[2, 3])
    assert after[0, 2] == 0.0
    with pytest.raises(MadocError, match=r"expected an action_delay and 6 times an action_lag of at most 0\.16 s"):
        CpuSimulator(task, threads=1).bind(np.array([[0.0, 0.03]]))
    # Over 0.02 s a lag of 0.01 s has passed on 1 - (1 - exp(-2)) / 2 of the command.
    assert after[1, 2] == pytest.approx(after[2, 2] * (1.0 - (1.0 - np.exp(-2.0)) / 2.0))


def test_blending_is_the_weighted_sum():
    shares = np.array([[[0.25, 0.75], [1.0, 0.0]]])[..., None]
    actions = np.array([[[[1.0, 8.0], [-1.0, 4.0]]]])
    np.testing.assert_array_equal(blend(shares, actions), [[[[-0.5, 5.0], [1.0, 8.0]]]])
    shares, actions = (np.insert(each, 1, value, axis=2) for each, value in ((shares, 0.0), (actions, 7.0)))
    np.testing.assert_array_equal(blend(shares, actions), [[[[-0.5, 5.0], [1.0, 8.0]]]])


@pytest.fixture
def cart(tmp_path):
    return CpuSimulator(load(write_robot(tmp_path, CART_SPEC + DELAY)).task, threads=1)


def moved(simulator, delay, state, action):
    system = simulator.bind(np.array([[1.0, delay]]))
    return system.step(np.array([[state]]), np.array([[[action]]]))[0, 0]


def test_half_a_step_late_on_a_double_integrator_by_hand(cart):
    # m = 1, forces of 10 a. For 0.01 s the last action, 0.4, then the new one, -0.2; semi-implicit Euler of 0.01 s:
    # v = 0.01 * 4 = 0.04, x = 0.0004; v = 0.04 - 0.01 * 2 = 0.02, x = 0.0004 + 0.0002 = 0.0006.
    assert cart.task.pending == 3
    end = moved(cart, 0.01, [0.0, 0.0, 0.4, 0.7, 0.9], -0.2)
    np.testing.assert_allclose(end, [0.0006, 0.02, -0.2, 0.4, 0.7], atol=1e-15)


def test_without_delay_nothing_is_late(cart):
    end = moved(cart, 0.0, [0.0, 0.0, 0.4, 0.7, 0.9], -0.2)
    np.testing.assert_allclose(end, [-0.0006, -0.04, -0.2, 0.4, 0.7], atol=1e-15)


def test_a_switch_within_a_physics_step_is_blended(cart):
    # 0.005 s of 4 N and 0.005 s of -2 N are 1 N over 0.01 s.
    end = moved(cart, 0.005, [0.0, 0.0, 0.4, 0.0, 0.0], -0.2)
    np.testing.assert_allclose(end[:2], [0.0001 - 0.0001, 0.01 - 0.02], atol=1e-15)


def test_what_follows_is_continuous_in_the_delay(cart):
    delays = np.linspace(0.0, 0.05, 101)
    system = cart.bind(np.stack([np.ones(101), delays], -1))
    state = np.broadcast_to([0.0, 0.0, 0.9, -0.8, 0.7], (101, 1, 5))
    ends = system.step(state, np.full((101, 1, 1), -1.0))[:, 0]
    assert np.abs(np.diff(ends[:, 1])).max() <= 20.0 * 5e-4 + 1e-12
    assert len(np.unique(ends[:, 1].round(9))) > 80


def test_a_delay_of_a_whole_step_is_the_action_before(cart):
    randomness = np.random.default_rng(0)
    actions, state = randomness.uniform(-1, 1, 6), cart.initial_state
    late, prompt = cart.bind(np.array([[1.0, STEP]])), cart.bind(np.array([[1.0, 0.0]]))
    later, sooner = state[None, None], state[None, None]
    for step, action in enumerate(actions):
        later = late.step(later, np.array([[[action]]]))
        if step:
            sooner = prompt.step(sooner, np.array([[[actions[step - 1]]]]))
    np.testing.assert_allclose(later[..., :2], sooner[..., :2], atol=1e-15)


def test_a_delay_longer_than_a_state_carries_is_refused(cart):
    with pytest.raises(MadocError, match=r"expected an action_delay of at most 0.06 s, got 0.07"):
        cart.bind(np.array([[1.0, 0.07]]))


def test_a_failed_row_loses_its_pending_actions_too(cart):
    system = cart.bind(np.array([[1.0, 0.01]]))
    state = np.tile(cart.initial_state, (1, 2, 1))
    state[0, 1, 3] = np.nan
    end = system.step(state, np.zeros((1, 2, 1)))
    assert np.isfinite(end[0, 0]).all()
    assert np.isnan(end[0, 1]).all()


def test_a_task_without_signals_has_none_to_bias(cart):
    from dataclasses import replace

    from madoc.parameters import ParameterSpace

    space = ParameterSpace((Parameter("signal_bias", "plce", -1.0, 1.0),))
    with pytest.raises(MadocError, match=r"signal_bias.plce: cart has no signal 'plce'; nearest: place"):
        CpuSimulator(replace(cart.task, parameters=space))
    with pytest.raises(MadocError, match="none of its observation's values has a name"):
        CpuSimulator(replace(cart.task, parameters=space, signals=()))


def test_a_delay_of_all_actions_and_one_of_a_single_action_are_refused_together(tmp_path):
    both = TWO_CARTS + "  - {field: action_delay, low: 0, high: 0.04}\n"
    with pytest.raises(MadocError, match="of all actions and of one cannot both be calibrated, and line 13 has one"):
        load(write_robot(tmp_path, both, carts=TWO_CARTS_MODEL))
    with pytest.raises(MadocError, match="the name of an action"):
        load(
            write_robot(
                tmp_path,
                TWO_CARTS.replace("push_left, low: 0, high: 0.04", "push, low: 0, high: 1"),
                carts=TWO_CARTS_MODEL,
            )
        )
