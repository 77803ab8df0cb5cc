"""Rollouts in a learnt dynamics model, on the device: the rows a model-based learner adds to the logged ones."""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from madoc.learning.actor_critic import Batch
from madoc.learning.dynamics_ensemble import Ensemble, bellman_inconsistency, uncertainty_penalty
from madoc.learning.dynamics_reward import reward_of
from madoc.learning.features import Features
from madoc.learning.networks import Network
from madoc.learning.sac_losses import TwinCritic, least_value
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


def mean_return(reward: Float[np.ndarray, "steps rows"], ended: Float[np.ndarray, "steps rows"]) -> float:
    """Mean over rows of the sum of rewards until each first ends."""
    under_way = np.concatenate([np.ones((1, reward.shape[1])), np.cumprod(1.0 - ended, axis=0)[:-1]])
    return float((reward * under_way).sum(0).mean())


Value = Callable[[Float[Array, "rows observation"]], Float[Array, " rows"]]
Bounds = tuple[Float[Array, " observation"], Float[Array, " observation"]]
"""The smallest and the largest observation that is imagined."""


class StateValue(eqx.Module):
    """V(s), estimated by the smaller of two critics at the action that a policy takes without noise."""

    policy: Policy
    critic: TwinCritic

    def __call__(self, observation: Float[Array, "*rows observation"]) -> Float[Array, "*rows"]:
        """The value of a batch of observations."""
        return jnp.minimum(*self.critic(observation, jnp.asarray(self.policy(observation))))


def worst_value(
    reward: Float[np.ndarray, " rows"], episode_starts: Int[np.ndarray, " episodes"], discount: float
) -> Float[Array, ""]:
    """The sum of discounted rewards of earning for ever the least mean reward of a logged episode; 0 if it is positive.

    The least reward of a single step in the place of the mean makes it so low that critics learn little else: -377 on
    HalfCheetah, whose logged policy is worth 900.
    """
    lengths = np.diff(np.append(episode_starts, len(reward)))
    return least_value(jnp.asarray(np.add.reduceat(reward, episode_starts) / lengths), discount)


def chosen_candidate(
    candidates: Float[Array, "candidates rows outputs"],
    rewards: Float[Array, "candidates rows"],
    selection_temperature: float,
    key: PRNGKeyArray,
) -> tuple[Float[Array, "rows outputs"], Float[Array, " rows"]]:
    """For each row one candidate and its dynamics reward, drawn with probability softmax(reward / temperature).

    At a temperature of 0 the candidate of the highest reward.
    """
    if selection_temperature:
        chosen = jax.random.categorical(key, rewards / selection_temperature, axis=0)
    else:
        chosen = rewards.argmax(0)
    rows = jnp.arange(candidates.shape[1])
    return candidates[chosen, rows], rewards[chosen, rows]


class Models(eqx.Module):
    """The models that rows are imagined in, with all that does not depend on who acts.

    Attributes:
        ensemble: The dynamics models.
        elites: Indices of the models to sample from.
        past: The discriminators of the dynamics reward.
        features: The standardisation of the data.
        logged: Observations to restart at.
        terminated: Whether the task ends at a state.
        state_of: The state at an observation.
        samples: Number of next states drawn from each elite.
        selection_temperature: Of the draw of one of them; 0 takes the one with the highest dynamics reward.
        threshold: The smallest dynamics reward of a row that looks real; a fall is a fall, whatever it looks like.
        worst: Value of a step that looks unreal and of all that follows it, which stands in the place of its reward.
    """

    ensemble: Ensemble
    elites: Int[Array, " elites"]
    past: Network
    features: Features
    logged: Float[Array, "logged observation"]
    terminated: Callable[[Array], Bool[Array, " rows"]]
    state_of: Callable[[Array], Array]
    samples: int
    selection_temperature: float
    threshold: float
    worst: Float[Array, ""]


@eqx.filter_jit
def imagine(
    models: Models,
    policy: Policy,
    under_way: ImaginedRows,
    value: Value | None,
    *,
    horizon: int,
    penalty: float,
    steps: int,
    key: PRNGKeyArray,
) -> tuple[ImaginedRows, Batch, dict[str, Array]]:
    """Act for `steps` steps in every row; rows that end restart at logged observations.

    Of the next states drawn from the models one is kept, the more likely the higher its dynamics reward (Luo et al.
    2024, section 4). Observations are clipped to the range of the logged ones, widened by its width on either side.

    A row whose dynamics reward is below the threshold looks unreal: nothing is known of what follows, so it ends and is
    worth the worst, as in MOReL (Kidambi et al. 2020, section 4). Left out of the replay, as the authors of MOREC leave
    it, an action that leads there has no target at all, and the policy comes to prefer it.

    Rows also restart after `horizon` steps. The models' uncertainty lowers the reward with the weight `penalty`; it is
    measured by a `value` as in MOBILE, without one as in MOPO.

    Returns:
        The rows after the last step, the transitions flat in time and row, and metrics.
    """
    low, high = models.logged.min(0), models.logged.max(0)
    bounds = low - (high - low), high + (high - low)

    def step(under_way: ImaginedRows, key: PRNGKeyArray) -> tuple[ImaginedRows, tuple[Batch, dict[str, Array]]]:
        return _step(models, policy, under_way, value, key, bounds=bounds, horizon=horizon, penalty=penalty)

    under_way, (rows, metrics) = jax.lax.scan(step, under_way, jax.random.split(key, steps))
    flat = {name: column.reshape(-1, *column.shape[2:]) for name, column in rows.items()}
    return under_way, flat, jax.tree.map(jnp.mean, metrics)


def _step(
    models: Models,
    policy: Policy,
    under_way: ImaginedRows,
    value: Value | None,
    key: PRNGKeyArray,
    *,
    bounds: Bounds,
    horizon: int,
    penalty: float,
) -> tuple[ImaginedRows, tuple[Batch, dict[str, Array]]]:
    """One step of every row: the rows after it, the transitions, and metrics."""
    of_action, of_sample, of_choice, of_restart = jax.random.split(key, 4)
    features, observation = models.features, under_way.observation
    action = policy(observation, of_action)
    pair = features.pair(observation, action)
    mean, std = models.ensemble(pair)
    elite_mean, elite_std = mean[models.elites], std[models.elites]
    outcome, reality = _outcome(models, pair, elite_mean, elite_std, (of_sample, of_choice))
    following = _within(bounds, features.following(observation, outcome[:, :-1]))
    if value is None:
        uncertainty = uncertainty_penalty(std, features)
    else:
        uncertainty = _inconsistency(models, value, observation, elite_mean, bounds)
    reward = features.reward_offset + features.reward_scale * outcome[:, -1]
    fell = models.terminated(models.state_of(following))
    unreal = (reality < models.threshold) & ~fell
    ends = fell | unreal
    row = {
        "observation": observation,
        "action": action,
        "reward": jnp.where(unreal, models.worst, reward - penalty * uncertainty),
        "next_observation": following,
        "terminated": ends.astype(jnp.float32),
    }
    again = ends | (under_way.age + 1 >= horizon)
    fresh = _some(models.logged, len(observation), of_restart)
    state = jnp.where(jnp.broadcast_to(again[:, None], fresh.shape), fresh, following)
    metrics = {
        "dynamics_reward": reality.mean(),
        "unreal": unreal.mean(),
        "penalty": uncertainty.mean(),
        "imagined_reward": reward.mean(),
        "net_reward": row["reward"].mean(),
    }
    return ImaginedRows(state, jnp.where(again, 0, under_way.age + 1)), (row, metrics)


def _outcome(
    models: Models,
    pair: Float[Array, "rows pair"],
    mean: Float[Array, "elites rows outputs"],
    std: Float[Array, "elites rows outputs"],
    keys: tuple[PRNGKeyArray, PRNGKeyArray],
) -> tuple[Float[Array, "rows outputs"], Float[Array, " rows"]]:
    """What is kept of what elites draw, standardised, and its dynamics reward; keys of the draws and of the choice."""
    shape = (models.samples, *mean.shape)
    noise = jax.random.normal(keys[0], shape)
    drawn = jnp.broadcast_to(mean, shape) + jnp.broadcast_to(std, shape) * noise
    candidates = drawn.reshape(-1, *mean.shape[1:])
    change = jnp.clip(candidates[..., :-1], -LARGEST_CHANGE, LARGEST_CHANGE)
    pairs = jnp.broadcast_to(pair, (*change.shape[:2], pair.shape[-1]))
    return chosen_candidate(
        jnp.concatenate([change, candidates[..., -1:]], axis=-1),
        reward_of(models.past, pairs, change),
        models.selection_temperature,
        keys[1],
    )


def _inconsistency(
    models: Models,
    value: Value,
    observation: Float[Array, "rows observation"],
    mean: Float[Array, "elites rows outputs"],
    bounds: Bounds,
) -> Float[Array, " rows"]:
    """How much elites differ on the value of what they expect to follow; where the task has ended it is 0."""
    expected = jnp.clip(mean[..., :-1], -LARGEST_CHANGE, LARGEST_CHANGE)
    beside = jnp.broadcast_to(observation, expected.shape)
    could_follow = _within(bounds, models.features.following(beside, expected)).reshape(-1, observation.shape[-1])
    worth = value(could_follow) * ~models.terminated(models.state_of(could_follow))
    return bellman_inconsistency(worth.reshape(len(models.elites), -1))


def _within(bounds: Bounds, observation: Float[Array, "*rows observation"]) -> Float[Array, "*rows observation"]:
    """Observations clipped to bounds."""
    return jnp.clip(observation, *(jnp.broadcast_to(bound, observation.shape) for bound in bounds))


def imagined_return(
    act: Callable[..., tuple[ImaginedRows, Batch, dict[str, Array]]],
    under_way: ImaginedRows,
    longest: int,
    key: PRNGKeyArray,
) -> float:
    """Mean return of rows until each first ends, or has taken `longest` steps.

    `act` takes some steps, as `imagine` does, from given rows and with a given `key`.
    """
    rows = len(under_way.age)
    reward, ended = np.zeros((0, rows)), np.zeros((0, rows))
    while len(reward) < longest and not (len(ended) and ended.any(0).all()):
        of_steps, key = jax.random.split(key)
        under_way, acted, _ = act(under_way=under_way, key=of_steps)
        reward = np.append(reward, np.reshape(acted["reward"], (-1, rows)), axis=0)
        ended = np.append(ended, np.reshape(acted["terminated"], (-1, rows)), axis=0)
    return mean_return(reward[:longest], ended[:longest])


def _some(logged: Array, rows: int, key: PRNGKeyArray) -> Array:
    return logged[jax.random.randint(key, (rows,), 0, len(logged))]
