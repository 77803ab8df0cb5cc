"""Rollouts: rows that end start again, time limits truncate, failed rows are counted, nothing leaks across ends."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import madoc.tasks
from madoc.runs.machine import choosable_cores
from madoc.simulation.cpu import CpuSimulator
from madoc.simulation.rollout import act, begin, chosen_states, reset_states, roll

KEY = jax.random.key(0)
OTHER = jax.random.key(1)
TESTS = Path(__file__).parents[1]
CORES = choosable_cores()


def push(observation, key=None):
    """Full force to the right, with noise where it is sampled."""
    action = jnp.ones((*observation.shape[:-1], 1))
    return action if key is None else action - 0.1 * jax.random.uniform(key, action.shape)


def constant(size):
    """A policy for any robot: 0.3 in every motor."""
    return lambda observation, key=None: jnp.full((*observation.shape[:-1], size), 0.3)


class Script:
    """A system whose next states are written down: `end(state, step)` with the steps counted."""

    def __init__(self, count, end):
        self.count = count
        self._end = end
        self._step = 0

    def step(self, state, action, force=None):
        end = self._end(state, self._step)
        self._step += 1
        return end

    def roll_out(self, state, actions, force=None):
        raise NotImplementedError

    def observe(self, state):
        return state

    def actuator_forces(self, state, action):
        raise NotImplementedError

    def unbiased(self, state):
        return state

    def replaced(self, systems, parameters):
        raise NotImplementedError


def test_axes_and_the_chain_of_states(spring_task):
    task = spring_task()
    simulator = CpuSimulator(task, threads=1)
    system = simulator.bind(np.stack([task.parameters.low + 0.1, task.parameters.high]))
    starts = reset_states(simulator)
    walkers = begin(starts, KEY, systems=2, rows=3)
    assert walkers.state.shape == (2, 3, 2)
    assert (walkers.age == 0).all()
    rollout, end = roll(system, task, push, walkers, steps=5, starts=starts, key=KEY, restart_key=OTHER)
    seen = rollout.transitions
    assert seen.observation.shape == (5, 2, 3, 2)
    assert seen.action.shape == (5, 2, 3, 1)
    assert seen.action.dtype == np.float64
    assert seen.reward.shape == rollout.valid.shape == (5, 2, 3)
    np.testing.assert_array_equal(seen.observation[0], walkers.state)
    np.testing.assert_array_equal(seen.observation[1:], seen.next_observation[:-1])
    np.testing.assert_array_equal(end.state, seen.next_observation[-1])
    np.testing.assert_array_equal(end.age, np.full((2, 3), 5))
    for step in range(5):
        expected = system.step(seen.observation[step], seen.action[step])
        np.testing.assert_array_equal(seen.next_observation[step], expected)
        np.testing.assert_array_equal(seen.reward[step], expected[..., 0] - seen.observation[step][..., 0])
    assert rollout.failures == 0


def test_two_halves_are_one_rollout(spring_task):
    # With a deterministic policy and no ends only the walkers carry over.
    task = spring_task()
    simulator = CpuSimulator(task, threads=1)
    system, starts = simulator.bind(task.parameters.middle[None]), reset_states(simulator)
    walkers = begin(starts, KEY, systems=1, rows=4)
    whole, end = roll(system, task, push, walkers, steps=8, starts=starts, key=None, restart_key=OTHER)
    first, between = roll(system, task, push, walkers, steps=4, starts=starts, key=None, restart_key=OTHER)
    second, last = roll(system, task, push, between, steps=4, starts=starts, key=None, restart_key=KEY)
    both = [first.transitions.next_observation, second.transitions.next_observation]
    np.testing.assert_array_equal(np.concatenate(both), whole.transitions.next_observation)
    np.testing.assert_array_equal(last.state, end.state)


def test_a_policy_recalls_the_changes_and_actions_of_earlier_steps_of_its_episode(spring_task):
    task, saw = spring_task(), []

    def looking(observation, key=None):
        jax.debug.callback(lambda seen: saw.append(np.asarray(seen)[0, 0]), observation, ordered=True)
        return jnp.full((*observation.shape[:-1], 1), 0.3)

    system, starts = Script(1, lambda state, step: state + 1.0 + step), chosen_states(np.zeros((1, 2)))
    walkers = begin(starts, KEY, systems=1, rows=1, recalled=6)
    _, end = roll(system, task, looking, walkers, steps=4, starts=starts, key=None, restart_key=OTHER)
    jax.effects_barrier()
    # x = 0, 1, 3, and beyond 3 the episode ends: each step recalls (Δx, Δẋ, a) of the last two, the latest first.
    expected = [[0, 0], [0, 0, 0], [0, 0, 0]], [[1, 1], [1, 1, 0.3], [0, 0, 0]], [[3, 3], [2, 2, 0.3], [1, 1, 0.3]]
    for seen, parts in zip(saw, (*expected, expected[0]), strict=True):
        np.testing.assert_allclose(seen, np.concatenate(parts), rtol=1e-6)
    assert not end.recalled.any()  # the fourth step ended at x = 4


def test_the_time_limit_truncates_and_restarts(spring_task):
    task = spring_task()
    simulator = CpuSimulator(task, threads=1)
    system, starts = simulator.bind(task.parameters.middle[None]), chosen_states(np.array([[0.25, 0.0]]))
    walkers = begin(starts, KEY, systems=1, rows=2)
    rollout, end = roll(system, task, push, walkers, steps=12, starts=starts, key=None, restart_key=OTHER)
    seen = rollout.transitions
    expected = np.zeros((12, 1, 2), dtype=bool)
    expected[9] = True
    np.testing.assert_array_equal(seen.truncated, expected)
    assert not seen.terminated.any()
    np.testing.assert_array_equal(seen.next_observation[9], system.step(seen.observation[9], seen.action[9]))
    np.testing.assert_array_equal(seen.observation[10], np.broadcast_to([0.25, 0.0], (1, 2, 2)))
    np.testing.assert_array_equal(seen.observation[10:], seen.observation[:2])
    np.testing.assert_array_equal(end.age, [[2, 2]])


def test_a_fall_terminates_and_restarts_that_row_alone(spring_task):
    task = spring_task()
    steps_right = Script(1, lambda state, _: state + np.array([1.0, 0.0]))
    state = np.array([[[0.0, 0.0], [2.5, 0.0]]])
    walkers = begin(lambda *_: state, KEY, systems=1, rows=2)
    starts = chosen_states(np.array([[-1.0, 7.0]]))
    rollout, end = roll(steps_right, task, push, walkers, steps=2, starts=starts, key=None, restart_key=OTHER)
    seen = rollout.transitions
    np.testing.assert_array_equal(seen.terminated[:, 0], [[False, True], [False, False]])
    assert not seen.truncated.any()
    assert rollout.valid.all()
    np.testing.assert_array_equal(seen.next_observation[0, 0], [[1.0, 0.0], [3.5, 0.0]])
    np.testing.assert_array_equal(seen.observation[1, 0], [[1.0, 0.0], [-1.0, 7.0]])
    np.testing.assert_array_equal(seen.reward, np.ones((2, 1, 2)))
    np.testing.assert_array_equal(end.age, [[2, 1]])


def test_a_fall_at_the_time_limit_is_a_fall(spring_task):
    task = spring_task()
    system = Script(1, lambda state, step: np.full((1, 1, 2), 4.0 if step == 9 else 0.0))
    starts = chosen_states(np.zeros((1, 2)))
    walkers = begin(starts, KEY, systems=1, rows=1)
    rollout, _ = roll(system, task, push, walkers, steps=10, starts=starts, key=None, restart_key=OTHER)
    assert rollout.transitions.terminated[9, 0, 0]
    assert not rollout.transitions.truncated.any()


def test_a_failed_row_is_invalid_finite_and_restarts(spring_task):
    def fail(state, step):
        end = state.copy()
        if step == 1:
            end[1, 0] = np.nan
        return end

    starts = chosen_states(np.array([[0.5, 0.0]]))
    walkers = begin(lambda *_: np.full((4, 2), -0.5), KEY, systems=2, rows=2)
    rollout, end = roll(
        Script(2, fail), spring_task(), push, walkers, steps=3, starts=starts, key=None, restart_key=OTHER
    )
    expected = np.ones((3, 2, 2), dtype=bool)
    expected[1, 1, 0] = False
    np.testing.assert_array_equal(rollout.valid, expected)
    assert rollout.failures == 1
    for column in jax.tree.leaves(rollout.transitions):
        assert np.isfinite(column).all()
    assert not (rollout.transitions.terminated | rollout.transitions.truncated)[1, 1, 0]
    np.testing.assert_array_equal(rollout.transitions.observation[2, 1, 0], [0.5, 0.0])
    np.testing.assert_array_equal(rollout.transitions.observation[2, 0], np.full((2, 2), -0.5))
    np.testing.assert_array_equal(end.age, [[3, 3], [1, 3]])


def test_same_keys_same_bits_and_other_keys_other_actions(spring_task):
    task = spring_task()
    simulator = CpuSimulator(task, threads=1)
    system, starts = simulator.bind(task.parameters.middle[None]), reset_states(simulator)
    walkers = begin(starts, KEY, systems=1, rows=4)

    def actions(key):
        rollout, _ = roll(system, task, push, walkers, steps=12, starts=starts, key=key, restart_key=OTHER)
        return rollout.transitions.action, rollout.transitions.observation

    for once, again in zip(actions(KEY), actions(KEY), strict=True):
        np.testing.assert_array_equal(once, again)
    sampled, _ = actions(KEY)
    assert (sampled != actions(OTHER)[0]).all()
    assert len(np.unique(sampled)) == sampled.size
    assert (actions(None)[0] == 1.0).all()


@pytest.mark.parametrize("name", madoc.tasks.TASKS)
def test_threads_do_not_change_a_rollout(name):
    ends = []
    for threads in (1, 2):
        simulator = CpuSimulator(madoc.tasks.make(name), threads=threads)
        system, starts = simulator.bind(np.stack([simulator.parameters.middle] * 2)), reset_states(simulator)
        walkers = begin(starts, KEY, systems=2, rows=6)
        policy = constant(simulator.action_size)
        rollout, _ = roll(system, simulator.task, policy, walkers, steps=30, starts=starts, key=None, restart_key=OTHER)
        ends.append(rollout.transitions.next_observation)
    np.testing.assert_array_equal(*ends)


def test_acting_is_traced_once_whatever_the_step():
    traces = []

    def policy(observation, key=None):
        traces.append(None)
        return observation + jax.random.uniform(key, ())

    actions = [act(policy, np.zeros((2, 3)), KEY, np.int32(step)) for step in range(10)]
    assert len(traces) == 1
    assert len({float(action[0, 0]) for action in actions}) == 10


def test_starts(hopper):
    drawn = reset_states(hopper)(KEY, 50)
    assert drawn.dtype == np.float64
    assert drawn.shape == (50, 12)
    assert 0 < abs(drawn - hopper.initial_state).max() <= 5e-3
    logged = np.arange(12.0).reshape(6, 2)
    drawn = chosen_states(logged)(KEY, 200)
    assert {tuple(row) for row in drawn} == {tuple(row) for row in logged}


def calibrated_on(cores):
    folders = [str(TESTS), str(TESTS.parent / "src")]
    plain = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run(
        ["taskset", "--cpu-list", ",".join(map(str, cores)), sys.executable, str(TESTS / "calibrating.py"), "wide"],
        env=plain | {"PYTHONPATH": os.pathsep.join(folders), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.skipif(len(CORES) < 2, reason="this machine has one core, or none to choose")
def test_same_seed_same_result_at_one_and_two_threads():
    one, two = calibrated_on(CORES[:1]), calibrated_on(CORES[:2])
    assert (one["threads"], two["threads"]) == (1, 2)
    assert one["mean"] == two["mean"]
