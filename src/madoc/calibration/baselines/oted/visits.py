"""The pairs (s, a) that data and simulator visit from the same starts, and the discriminator that compares them."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from madoc.data import Dataset
from madoc.identification.windows import first_rows
from madoc.learning import replay
from madoc.learning.dynamics_reward import discriminator_loss
from madoc.learning.networks import Network, minimise
from madoc.types import Transitions


def comparable_starts(dataset: Dataset, rows: Int[np.ndarray, " states"], horizon: int) -> Int[np.ndarray, " starts"]:
    """Positions in `rows` at which a rollout may start: the log goes on for `horizon` steps, or until a fall.

    Raises:
        MadocError: No episode is long enough.
    """
    episode = dataset.episode_of(rows)
    falls = np.asarray(dataset.transitions.terminated)[dataset.episode_ends - 1][episode]
    whole = np.zeros(len(rows), dtype=bool)
    whole[first_rows(dataset, rows, horizon)] = True
    return np.flatnonzero(whole | falls)


def visits(dataset: Dataset, starts: Int[np.ndarray, " starts"], horizon: int) -> Int[np.ndarray, " rows"]:
    """How often each row of the log is visited 1 to `horizon` - 1 steps after one of the starts, in its episode.

    Rows drawn in proportion to these counts are distributed as the true system's visits from the starts. Rows drawn
    uniformly are not: the beginning of an episode is seldom reached from another start.
    """
    before = np.append(0, np.cumsum(np.bincount(starts, minlength=len(dataset))))
    row = np.arange(len(dataset))
    first = dataset.episode_starts[dataset.episode_of(row)]
    return before[row] - before[np.maximum(first, row - horizon + 1)]


def first_lives(seen: Transitions, valid: Bool[np.ndarray, " steps *rows"]) -> Bool[np.ndarray, " steps *rows"]:
    """Valid steps of each row before its first end or failure; later steps began at another start."""
    ended = np.asarray(seen.terminated) | np.asarray(seen.truncated) | ~valid
    earlier = np.concatenate([np.zeros_like(ended[:1]), ended[:-1]])
    return valid & ~np.logical_or.accumulate(earlier, axis=0)


@eqx.filter_jit
def log_ratio(discriminator: Network, pairs: Float[Array, "*rows pair"]) -> Float[Array, "*rows"]:
    """The discriminator's estimate of log p_data(s, a) / p_sim(s, a)."""
    return discriminator(pairs)[..., 0]


@eqx.filter_jit
def learn(
    discriminator: Network,
    optimiser_state: PyTree,
    logged: Float[Array, "rows pair"],
    reached: Int[Array, " rows"],
    rows: replay.Replay,
    key: PRNGKeyArray,
    *,
    optimiser: optax.GradientTransformation,
    batch: int,
    count: int,
) -> tuple[Network, PyTree, Float[Array, ""]]:
    """`count` updates of the discriminator on logged and simulated pairs; also the mean loss.

    Its cross-entropy leads its logit to log p_data(s, a) / p_sim(s, a).
    `reached` is the running sum of the weights with which logged pairs are drawn.
    """

    def loss_of(discriminator: Network, key: PRNGKeyArray) -> Float[Array, ""]:
        of_logged, of_simulated = jax.random.split(key)
        drawn = jax.random.randint(of_logged, (batch,), 0, reached[-1])
        chosen = logged[jnp.searchsorted(reached, drawn, side="right")]
        simulated = replay.sample(rows, of_simulated, batch)["pair"]
        return discriminator_loss(discriminator(chosen)[:, 0], discriminator(simulated)[:, 0])

    return minimise(loss_of, discriminator, optimiser_state, key, optimiser=optimiser, count=count)


LOG_STD_RANGE = (-6.0, 0.5)
"""Range of the log standard deviation of a parameter before tanh; steps beyond it are clipped."""
REWARD_BOUND = 10.0
"""Largest absolute log ratio of a pair; larger ones are clipped, as the discriminator is then certain anyway."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Distribution:
    """Independent Gaussians whose tanh are parameters in [-1, 1]."""

    mean: Float[np.ndarray, " d"]
    log_std: Float[np.ndarray, " d"]


def antithetic_noise(key: PRNGKeyArray, pairs: int, count: int) -> Float[np.ndarray, "draws d"]:
    """Standard normal draws, each with its mirror image, so that the even part of the reward cancels."""
    half = np.asarray(jax.random.normal(key, (pairs, count)), np.float64)
    return np.concatenate([half, -half])


def mean_rewards(
    log_ratio: Float[np.ndarray, "steps draws rows"], valid: Bool[np.ndarray, "steps draws rows"]
) -> Float[np.ndarray, " draws"]:
    """Reward of each draw: the mean of log p_data / p_sim over the pairs it visited.

    Its mean over draws is -KL(sim || data), and the part of the gradient that goes through p_sim is 0 on average, so
    that the bandit minimises this divergence. The choice of this KL is ours. A draw whose rows all failed gets the
    lowest reward of all draws.
    """
    count = valid.sum((0, 2))
    total = np.where(valid, np.clip(log_ratio, -REWARD_BOUND, REWARD_BOUND), 0.0).sum((0, 2))
    rewards = total / np.maximum(count, 1)
    lowest = rewards[count > 0].min() if count.any() else -REWARD_BOUND
    return np.where(count, rewards, lowest)


def advantages(rewards: Float[np.ndarray, " draws"]) -> Float[np.ndarray, " draws"]:
    """Standardised rewards, so that the size of a step does not depend on their unit."""
    return (rewards - rewards.mean()) / (rewards.std() + 1e-8)


def natural_step(
    distribution: Distribution,
    noise: Float[np.ndarray, "draws d"],
    advantage: Float[np.ndarray, " draws"],
    *,
    mean_rate: float,
    std_rate: float,
) -> Distribution:
    """The bandit's policy gradient, preconditioned by the Fisher matrix of a Gaussian (Wierstra et al. 2014).

    Score-function gradient of the expected reward: μ by A ε / σ, log σ by A (ε² - 1); the Fisher matrix is 1 / σ² and
    2. So μ moves by σ E[A ε], log σ by ½ E[A (ε² - 1)].
    """
    weight = advantage[:, None] / len(advantage)
    mean = distribution.mean + mean_rate * np.exp(distribution.log_std) * (weight * noise).sum(0)
    log_std = distribution.log_std + 0.5 * std_rate * (weight * (noise**2 - 1.0)).sum(0)
    return Distribution(mean, np.clip(log_std, *LOG_STD_RANGE))
