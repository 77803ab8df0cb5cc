"""Rollouts in a learnt dynamics model, on the device: the rows a model-based learner adds to the logged ones."""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from madoc.learning.actor_critic import Batch
from madoc.learning.dynamics_ensemble import Ensemble, uncertainty_penalty
from madoc.learning.dynamics_reward import reward_of
from madoc.learning.features import Features
from madoc.learning.networks import Network
from madoc.types import Policy

LARGEST_CHANGE = 10.0
"""Largest change of an observation in one step, in standard deviations of the change; larger samples are clipped."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ImaginedRows:
    """The observations of imagined rows, and their ages in steps."""

    observation: Float[Array, "rows observation"]
    age: Int[Array, " rows"]


def start_imagining(logged: Float[Array, "logged observation"], rows: int, key: PRNGKeyArray) -> ImaginedRows:
    """Rows at logged observations."""
    return ImaginedRows(_some(logged, rows, key), jnp.zeros(rows, jnp.int32))


class WithoutNoise(eqx.Module):
    """A policy that does what another does without a key."""

    policy: Policy

    def __call__(
        self, observation: Float[Array, "*rows observation"], key: PRNGKeyArray | None = None
    ) -> Float[Array, "*rows action"]:
        """Actions for a batch of observations, whatever the key."""
        return jnp.asarray(self.policy(observation))


def mean_return(
    reward: Float[Array, " transitions"], ended: Float[Array, " transitions"], *, rows: int
) -> Float[Array, ""]:
    """Mean over rows of the sum of rewards until each first ends, of transitions flat in time and row."""
    reward, ended = reward.reshape(-1, rows), ended.reshape(-1, rows)
    under_way = jnp.concatenate([jnp.ones((1, rows)), jnp.cumprod(1.0 - ended, axis=0)[:-1]])
    return (reward * under_way).sum(0).mean()


def best_candidate(
    candidates: Float[Array, "candidates rows outputs"], rewards: Float[Array, "candidates rows"]
) -> tuple[Float[Array, "rows outputs"], Float[Array, " rows"]]:
    """For each row the candidate of the highest dynamics reward, and that reward."""
    best = rewards.argmax(0)
    rows = jnp.arange(candidates.shape[1])
    return candidates[best, rows], rewards[best, rows]


@eqx.filter_jit
def imagine(
    ensemble: Ensemble,
    elites: Int[Array, " elites"],
    past: Network,
    features: Features,
    policy: Policy,
    under_way: ImaginedRows,
    *,
    logged: Float[Array, "logged observation"],
    terminated: Callable[[Array], Bool[Array, " rows"]],
    state_of: Callable[[Array], Array],
    samples: int,
    threshold: float,
    horizon: int,
    penalty: float,
    steps: int,
    key: PRNGKeyArray,
) -> tuple[ImaginedRows, Batch, dict[str, Array]]:
    """Act for `steps` steps in every row; rows that end restart at logged observations.

    Of the next states drawn from the models, the one with the highest dynamics reward is kept (Luo et al. 2024, section
    4). Observations are clipped to the range of the logged ones, widened by its width on either side.

    Args:
        ensemble: The dynamics models.
        elites: Indices of the models to sample from.
        past: The discriminators of the dynamics reward.
        features: The standardisation of the data.
        policy: The policy that acts.
        under_way: The rows.
        logged: Observations to restart at.
        terminated: Whether the task ends at a state.
        state_of: The state at an observation.
        samples: Number of next states drawn from each elite.
        threshold: A row whose best dynamics reward is below looks unreal; it is `stopped` and restarts, unless it fell.
        horizon: Number of steps after which a row restarts.
        penalty: λ of MOPO, the weight of the models' uncertainty in the reward.
        steps: Number of steps.
        key: Randomness.

    Returns:
        The rows after the last step, the transitions flat in time and row, and metrics. Transitions have a column more
        than logged ones, `stopped`: those that look unreal are not to be learnt from, as nothing is known of what
        follows them.
    """
    low, high = logged.min(0), logged.max(0)
    low, high = low - (high - low), high + (high - low)

    def step(under_way: ImaginedRows, key: PRNGKeyArray) -> tuple[ImaginedRows, tuple[Batch, dict[str, Array]]]:
        of_action, of_sample, of_restart = jax.random.split(key, 3)
        observation = under_way.observation
        action = policy(observation, of_action)
        pair = features.pair(observation, action)
        mean, std = ensemble(pair)
        elite_mean, elite_std = mean[elites], std[elites]
        shape = (samples, *elite_mean.shape)
        noise = jax.random.normal(of_sample, shape)
        drawn = jnp.broadcast_to(elite_mean, shape) + jnp.broadcast_to(elite_std, shape) * noise
        candidates = drawn.reshape(-1, *elite_mean.shape[1:])
        change = jnp.clip(candidates[..., :-1], -LARGEST_CHANGE, LARGEST_CHANGE)
        pairs = jnp.broadcast_to(pair, (*change.shape[:2], pair.shape[-1]))
        outcome, reality = best_candidate(
            jnp.concatenate([change, candidates[..., -1:]], axis=-1), reward_of(past, pairs, change)
        )
        following = features.following(observation, outcome[:, :-1])
        following = jnp.clip(following, jnp.broadcast_to(low, following.shape), jnp.broadcast_to(high, following.shape))
        uncertainty = uncertainty_penalty(std, features)
        reward = features.reward_offset + features.reward_scale * outcome[:, -1]
        fell = terminated(state_of(following))
        unreal = (reality < threshold) & ~fell
        ends = fell | unreal
        row = {
            "observation": observation,
            "action": action,
            "reward": reward - penalty * uncertainty,
            "next_observation": following,
            "terminated": fell.astype(jnp.float32),
            "stopped": unreal.astype(jnp.float32),
        }
        again = ends | (under_way.age + 1 >= horizon)
        fresh = _some(logged, len(observation), of_restart)
        state = jnp.where(jnp.broadcast_to(again[:, None], fresh.shape), fresh, following)
        metrics = {
            "dynamics_reward": reality.mean(),
            "stopped": unreal.mean(),
            "penalty": uncertainty.mean(),
            "imagined_reward": reward.mean(),
            "net_reward": row["reward"].mean(),
        }
        return ImaginedRows(state, jnp.where(again, 0, under_way.age + 1)), (row, metrics)

    under_way, (rows, metrics) = jax.lax.scan(step, under_way, jax.random.split(key, steps))
    flat = {name: column.reshape(-1, *column.shape[2:]) for name, column in rows.items()}
    return under_way, flat, jax.tree.map(jnp.mean, metrics)


def _some(logged: Array, rows: int, key: PRNGKeyArray) -> Array:
    return logged[jax.random.randint(key, (rows,), 0, len(logged))]
