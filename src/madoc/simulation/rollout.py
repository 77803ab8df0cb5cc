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
    """Rows of a rollout: their states, the control steps since each started, and what a policy recalls of those.

    A policy that recalls m rows sees, behind the observation s, the changes and actions (s - s₋₁, a₋₁), (s₋₁ - s₋₂,
    a₋₂), ... of the last m steps, the latest first, and 0 for steps before the start. It recalls none by default.
    """

    state: Float[np.ndarray, "systems rows state"]
    age: Int[np.ndarray, "systems rows"]
    recalled: Float[np.ndarray, "systems rows recalled"]


@dataclass(frozen=True)
class Rollout:
    """Transitions of a rollout, time on the first axis. Rows whose simulation failed are not `valid`."""

    transitions: Transitions
    valid: Bool[np.ndarray, "steps systems rows"]

    @property
    def failures(self) -> int:
        """Number of rows whose simulation failed."""
        return int((~self.valid).sum())

    def of_systems(self, systems: slice) -> "Rollout":
        """The rows of some of the systems."""
        transitions = jax.tree.map(lambda column: column[:, systems], self.transitions)
        return Rollout(transitions, self.valid[:, systems])


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


def begin(starts: Starts, key: PRNGKeyArray, *, systems: int, rows: int, recalled: int = 0) -> Walkers:
    """Rows at fresh starts, for a policy that recalls so many numbers of earlier steps."""
    state = starts(key, systems * rows).reshape(systems, rows, -1)
    return Walkers(state, np.zeros((systems, rows), dtype=np.int64), np.zeros((systems, rows, recalled)))


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
    state, age, recalled = walkers.state, walkers.age, walkers.recalled
    observation = system.observe(state)
    frames = []
    for step in range(steps):
        seen = np.concatenate([observation, recalled], axis=-1) if recalled.shape[-1] else observation
        action = np.asarray(act(policy, seen, key, np.int32(step)), dtype=np.float64)
        next_state = system.step(state, action)
        valid = np.isfinite(next_state).all(-1)
        safe = np.where(valid[..., None], next_state, state)
        terminated = task.terminated(safe) & valid
        truncated = (age + 1 >= task.max_episode_steps) & ~terminated & valid
        following = system.observe(safe)
        reward = task.reward(state, action, safe)
        frames.append((observation, action, reward, following, terminated, truncated, valid))
        latest = np.concatenate([following - observation, action, recalled], axis=-1)
        state, age, observation, recalled = safe, age + 1, following, latest[..., : recalled.shape[-1]]
        ended = terminated | truncated | ~valid
        if ended.any():
            fresh = starts(jax.random.fold_in(restart_key, step), ended.size)
            state = np.where(ended[..., None], fresh.reshape(state.shape), state)
            age, recalled = np.where(ended, 0, age), np.where(ended[..., None], 0.0, recalled)
            observation = system.observe(state)
    *columns, valid = (np.stack(column) for column in zip(*frames, strict=True))
    return Rollout(Transitions(*columns), valid), Walkers(state, age, recalled)


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
def _reset_noise(noise: Callable[[PRNGKeyArray, int], Array], key: PRNGKeyArray, count: int) -> Array:
    return noise(key, count)
