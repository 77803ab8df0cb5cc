"""The losses of soft actor-critic (Haarnoja et al. 2018, arXiv 1812.05905), one function an equation."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from madoc.learning.networks import Actions, Network, PerRow, Scalar, standardise
from madoc.learning.tanh_gaussian import Noise, TanhGaussianPolicy, sample


class TwinCritic(eqx.Module):
    """Two independently initialised action values of standardised observations."""

    first: Network
    second: Network
    offset: Float[Array, " observation"]
    scale: Float[Array, " observation"]

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        hidden: tuple[int, ...],
        *,
        key: PRNGKeyArray,
        offset: Array | None = None,
        scale: Array | None = None,
    ) -> None:
        first, second = jax.random.split(key)
        self.first = Network(observation_size + action_size, 1, hidden, key=first)
        self.second = Network(observation_size + action_size, 1, hidden, key=second)
        self.offset = jnp.zeros(observation_size) if offset is None else offset
        self.scale = jnp.ones(observation_size) if scale is None else scale

    def __call__(
        self, observation: Float[Array, "*rows observation"], action: Float[Array, "*rows action"]
    ) -> tuple[Float[Array, "*rows"], Float[Array, "*rows"]]:
        """Both values of every row."""
        pair = jnp.concatenate([standardise(observation, self.offset, self.scale), action], axis=-1)
        return self.first(pair)[..., 0], self.second(pair)[..., 0]


def soft_target(
    reward: PerRow,
    terminated: PerRow,
    next_value: PerRow,
    next_log_density: PerRow,
    *,
    temperature: Scalar,
    discount: float | PerRow,
) -> PerRow:
    """Eq. (2) and (3): r + γ (1 - terminated) (min Q(s', a') - α log π(a'|s'))."""
    return reward + discount * (1.0 - terminated) * (next_value - temperature * next_log_density)


def least_value(reward: PerRow, discount: float) -> Scalar:
    """The least sum of discounted rewards if none is below the least one given; 0 if that is positive, as episodes end.

    Entropy and penalties of the models are not counted. It is minus infinity for negative rewards without a discount.
    """
    least = jnp.minimum(reward.min(), 0.0)
    return jnp.where(least < 0.0, least / jnp.float32(1.0 - discount), 0.0)


def critic_loss(critic: TwinCritic, observation: Array, action: Array, target: PerRow) -> Scalar:
    """Eq. (5): half the mean squared Bellman error, summed over the twins."""
    first, second = critic(observation, action)
    return 0.5 * (jnp.mean((first - target) ** 2) + jnp.mean((second - target) ** 2))


def actor_loss(
    policy: TanhGaussianPolicy, critic: TwinCritic, observation: Array, *, temperature: Scalar, noise: Noise
) -> tuple[Scalar, tuple[PerRow, PerRow]]:
    """Eq. (7): mean of α log π(a|s) - min Q(s, a). Also returns the values and log densities, per row."""
    action, density = sample(*policy.distribution(observation), noise)
    value = jnp.minimum(*critic(observation, action))
    return jnp.mean(temperature * density - value), (value, density)


def temperature_loss(log_temperature: Scalar, log_density: PerRow, target_entropy: float) -> Scalar:
    """Eq. (18), on log α: -log α (log π + target entropy), averaged."""
    return -jnp.mean(log_temperature * jax.lax.stop_gradient(log_density + target_entropy))


def cloning_error(policy: TanhGaussianPolicy, observation: Array, action: Actions) -> Scalar:
    """Mean squared distance of the deterministic action to the data's (TD3+BC, Fujimoto & Gu 2021, Eq. 3)."""
    return jnp.mean((policy(observation) - action) ** 2)


def cloned_actor_loss(loss: Scalar, value: PerRow, error: Scalar, *, weight: float) -> Scalar:
    """SAC+BC: w / mean|Q| times SAC's loss, plus the cloning error (TD3+BC's Eq. 5); no gradient through mean|Q|."""
    return weight / jax.lax.stop_gradient(jnp.abs(value).mean()) * loss + error
