"""The bandit: a Gaussian distribution of parameters, the reward of each draw, and the policy gradient."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

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
