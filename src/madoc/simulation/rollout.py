"""Closed-loop rollouts: a policy acts in systems, rows that end start again, failed rows are counted."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from madoc.simulation.base import Simulator, System
from madoc.tasks.base import Task
from madoc.types import Policy, Transitions

Starts = Callable[[PRNGKeyArray, int], Float[np.ndarray, "count state"]]
"""(key, count) -> states at which rows start."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Walkers:
    """Rows of a rollout: their states, and the control steps since each started."""

    state: Float[np.ndarray, "systems rows state"]
    age: Int[np.ndarray, "systems rows"]


@dataclass(frozen=True)
class Rollout:
    """Transitions of a rollout, time on the first axis. Rows whose simulation failed are not `valid`."""

    transitions: Transitions
    valid: Bool[np.ndarray, "steps systems rows"]

    @property
    def failures(self) -> int:
        """Number of rows whose simulation failed."""
        return int((~self.valid).sum())


def reset_states(simulator: Simulator) -> Starts:
    """Starts drawn by the task's own reset."""

    def draw(key: PRNGKeyArray, count: int) -> np.ndarray:
        task = simulator.task
        noise = _reset_noise(task.reset_noise, key, count) if task.traced_reset else task.reset_noise(key, count)
        return simulator.initial_state + np.asarray(noise, dtype=np.float64)

    return draw


def chosen_states(states: Float[np.ndarray, "logged state"]) -> Starts:
    """Starts drawn uniformly from given states."""

    def draw(key: PRNGKeyArray, count: int) -> np.ndarray:
        return states[np.asarray(jax.random.randint(key, (count,), 0, len(states)))]

    return draw


def unbiased_starts(system: System, starts: Starts) -> Starts:
    """Starts at states rebuilt from the log, corrected for the bias of each system's sensors."""

    def draw(key: PRNGKeyArray, count: int) -> np.ndarray:
        states = starts(key, count)
        return system.unbiased(states.reshape(system.count, -1, states.shape[-1])).reshape(states.shape)

    return draw


def begin(starts: Starts, key: PRNGKeyArray, *, systems: int, rows: int) -> Walkers:
    """Rows at fresh starts."""
    state = starts(key, systems * rows).reshape(systems, rows, -1)
    return Walkers(state, np.zeros((systems, rows), dtype=np.int64))


def out_of_step(walkers: Walkers, time_limit: int) -> Walkers:
    """The same rows with evenly spread ages, so that they do not all reach the time limit together."""
    count = walkers.age.size
    return replace(walkers, age=(np.arange(count) * time_limit // count).reshape(walkers.age.shape))


def roll(
    system: System,
    task: Task,
    policy: Policy,
    walkers: Walkers,
    *,
    steps: int,
    starts: Starts,
    key: PRNGKeyArray | None,
    restart_key: PRNGKeyArray,
) -> tuple[Rollout, Walkers]:
    """Act for `steps` control steps in every row.

    A row that terminates, fails, or reaches the task's time limit starts again at a state from `starts`. Actions are
    sampled with `key`, or deterministic where it is None.

    Returns:
        Transitions with axes (steps, systems, rows), and the states of the rows afterwards.
    """
    state, age = walkers.state, walkers.age
    observation = system.observe(state)
    frames = []
    for step in range(steps):
        action = np.asarray(act(policy, observation, key, np.int32(step)), dtype=np.float64)
        next_state = system.step(state, action)
        valid = np.isfinite(next_state).all(-1)
        safe = np.where(valid[..., None], next_state, state)
        terminated = task.terminated(safe) & valid
        truncated = (age + 1 >= task.max_episode_steps) & ~terminated & valid
        following = system.observe(safe)
        reward = task.reward(state, action, safe)
        frames.append((observation, action, reward, following, terminated, truncated, valid))
        state, age, observation = safe, age + 1, following
        ended = terminated | truncated | ~valid
        if ended.any():
            fresh = starts(jax.random.fold_in(restart_key, step), ended.size)
            state = np.where(ended[..., None], fresh.reshape(state.shape), state)
            age = np.where(ended, 0, age)
            observation = system.observe(state)
    *columns, valid = (np.stack(column) for column in zip(*frames, strict=True))
    return Rollout(Transitions(*columns), valid), Walkers(state, age)


@eqx.filter_jit
def act(
    policy: Policy,
    observation: Float[Array | np.ndarray, "*rows observation"],
    key: PRNGKeyArray | None,
    step: Int[Array | np.ndarray, ""] | np.int32,
) -> Array:
    """Actions of a policy, jitted: sampled with the key of this step, deterministic without a key."""
    return policy(jnp.asarray(observation), None if key is None else jax.random.fold_in(key, step))


@partial(jax.jit, static_argnums=(0, 2))
def _reset_noise(noise: Callable, key: PRNGKeyArray, count: int) -> Array:
    return noise(key, count)


def replay_actions(
    system: System,
    task: Task,
    states: Float[np.ndarray, "logged state"],
    actions: Float[np.ndarray, "logged action"],
    *,
    rows: int,
    key: PRNGKeyArray,
) -> Rollout:
    """One control step from logged states under their logged actions; `rows` of them are drawn for each system."""
    chosen = np.asarray(jax.random.randint(key, (system.count, rows), 0, len(states)))
    state, action = system.unbiased(states[chosen]), actions[chosen]
    next_state = system.step(state, action)
    valid = np.isfinite(next_state).all(-1)
    safe = np.where(valid[..., None], next_state, state)
    terminated = task.terminated(safe) & valid
    reward, ended = task.reward(state, action, safe), np.zeros_like(terminated)
    seen = Transitions(system.observe(state), action, reward, system.observe(safe), terminated, ended)
    return Rollout(jax.tree.map(lambda column: column[None], seen), valid[None])
