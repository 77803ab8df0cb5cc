"""A clone that acts on a window of rows: it closes the loop as the logged policy did where velocities are hidden.

A policy that sees positions alone falls where the logged one walks. The rows before the last one tell the velocities.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.learning.cloning import Clone, Pairs, fresh_clone
from madoc.learning.features import Scaling, last_rows
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.simulation.base import System
from madoc.simulation.rollout import Rollout, Walkers, begin, out_of_step, reset_states, roll


class Remembering(eqx.Module):
    """A policy that acts on the observation, standardised, and on the features of the rows before it."""

    policy: TanhGaussianPolicy
    offset: Float[Array, " observation"]
    scale: Float[Array, " observation"]
    memory: Float[Array, "*rows memory"]

    def __call__(
        self, observation: Float[Array, "*rows observation"], key: PRNGKeyArray | None = None
    ) -> Float[Array, "*rows action"]:
        """Actions at these observations, each with its own memory."""
        offset, scale = (jnp.broadcast_to(part, observation.shape) for part in (self.offset, self.scale))
        seen = (observation - offset) / scale
        return self.policy(jnp.concatenate([seen.astype(jnp.float32), self.memory], axis=-1), key)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Actors:
    """Rows that the clone acts in, and the features of the rows that each has behind it, the latest first."""

    walkers: Walkers
    memory: Float[np.ndarray, "systems rows remembered features"]


def logged_pairs(problem: CalibrationProblem, length: int) -> Pairs:
    """What the clone is to act on, and how: windows of `length` logged rows, without the last action."""
    size = problem.simulator.task.observation_size
    windows = problem.features.windows("standardised", length)[1][0]
    seen = jnp.concatenate([windows[:, :size], windows[:, size + problem.simulator.action_size :]], axis=-1)
    action = np.asarray(problem.dataset.transitions.action)[last_rows(problem.dataset, length)]
    return seen, jnp.asarray(action, jnp.float32)


def fresh_actor(
    problem: CalibrationProblem, length: int, hidden: tuple[int, ...], *, learning_rate: float, key: PRNGKeyArray
) -> Clone:
    """An untrained clone that acts on windows of `length` rows."""
    seen, action = map(np.asarray, logged_pairs(problem, length))
    rows = problem.dataset.transitions.take(np.arange(len(action)))
    rows = replace(rows, observation=seen, action=action, next_observation=seen)
    return fresh_clone(rows, hidden, learning_rate=learning_rate, key=key)


def begin_acting(problem: CalibrationProblem, length: int, key: PRNGKeyArray, *, systems: int, rows: int) -> Actors:
    """Rows at resets, with evenly spread ages and nothing behind them."""
    simulator = problem.simulator
    walkers = begin(reset_states(simulator), key, systems=systems, rows=rows)
    walkers = out_of_step(walkers, simulator.task.max_episode_steps)
    return Actors(walkers, np.zeros((systems, rows, length - 1, _features(problem)), np.float32))


def act_freely(
    problem: CalibrationProblem,
    system: System,
    policy: TanhGaussianPolicy,
    actors: Actors,
    *,
    steps: int,
    key: PRNGKeyArray,
) -> tuple[Rollout, Actors]:
    """The clone acts for `steps` control steps from where its rows are, each step on a window of rows."""
    simulator, scaling = problem.simulator, problem.features.standardised
    size = simulator.task.observation_size
    offset, scale = (jnp.asarray(part[:size], jnp.float32) for part in (scaling.pair_offset, scaling.pair_scale))
    starts, of_actions, of_restarts = reset_states(simulator), *jax.random.split(key)
    walkers, memory, frames = actors.walkers, actors.memory, []
    for step in range(steps):
        flat = jnp.asarray(memory.reshape(*memory.shape[:2], -1))
        rollout, walkers = roll(
            system,
            simulator.task,
            Remembering(policy, offset, scale, flat),
            walkers,
            steps=1,
            starts=starts,
            key=jax.random.fold_in(of_actions, step),
            restart_key=jax.random.fold_in(of_restarts, step),
        )
        memory = remembered(scaling, memory, rollout)
        frames.append(rollout)
    transitions = jax.tree.map(lambda *parts: np.concatenate(parts), *(frame.transitions for frame in frames))
    return Rollout(transitions, np.concatenate([frame.valid for frame in frames])), Actors(walkers, memory)


def remembered(
    scaling: Scaling, memory: Float[np.ndarray, "systems rows remembered features"], step: Rollout
) -> Float[np.ndarray, "systems rows remembered features"]:
    """The memory after one more control step: its row comes first, the oldest is forgotten; nothing after a restart."""
    if not memory.shape[2]:
        return memory
    seen = step.transitions
    pair, change = scaling.features(seen)
    row = np.concatenate([change, pair[..., change.shape[-1] :]], axis=-1)[0]
    following = np.concatenate([row[:, :, None], memory[:, :, :-1]], axis=2)
    ended = (np.asarray(seen.terminated) | np.asarray(seen.truncated) | ~step.valid)[0]
    return np.where(ended[..., None, None], np.float32(0.0), following)


def _features(problem: CalibrationProblem) -> int:
    """Features of one row behind the last: the change of the observation, and the action."""
    return problem.simulator.task.observation_size + problem.simulator.action_size
