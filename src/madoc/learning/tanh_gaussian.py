"""Tanh-squashed Gaussians: sampling, densities, and the policy made of one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from madoc.learning.networks import Network, standardise

LOG_STD_RANGE = (-5.0, 2.0)
"""Range of the log standard deviation before squashing; values beyond it are clipped."""
_EDGE = 1.0 - 1e-5
"""Largest absolute action that has a density; recorded actions beyond it, such as ±1, are replaced by it."""
Values = Float[Array | np.ndarray, "*rows n"]


Noise = PRNGKeyArray | Float[Array, "*rows n"]
"""A random key, or standard normal numbers drawn beforehand: drawing those of many updates together is faster."""


def sample(mean: Values, log_std: Values, noise: Noise) -> tuple[Float[Array, "*rows n"], Float[Array, "*rows"]]:
    """A reparameterised draw in (-1, 1) and its log density."""
    if jnp.issubdtype(noise.dtype, jax.dtypes.prng_key):
        noise = jax.random.normal(noise, mean.shape)
    raw = mean + jnp.exp(log_std) * noise
    return jnp.tanh(raw), _log_density(raw, mean, log_std)


def log_density(value: Values, mean: Values, log_std: Values) -> Float[Array, "*rows"]:
    """Log density of values in [-1, 1]."""
    return _log_density(jnp.arctanh(jnp.clip(value, -_EDGE, _EDGE)), mean, log_std)


def _log_density(raw: Values, mean: Values, log_std: Values) -> Array:
    """Log N(raw; mean, std) - log |d tanh(raw) / d raw|, summed over the last axis (SAC, appendix C)."""
    standard = (raw - mean) * jnp.exp(-log_std)
    normal = -0.5 * standard**2 - log_std - 0.5 * np.log(2 * np.pi)
    log_slope = 2.0 * (np.log(2.0) - raw - jax.nn.softplus(-2.0 * raw))
    # The sum as a product: XLA does not vectorise exponentials and logarithms that it fuses into a sum, on a CPU.
    return jnp.matmul(normal - log_slope, jnp.ones(raw.shape[-1], raw.dtype), precision="highest")


class TanhGaussianPolicy(eqx.Module):
    """A policy: standardised observation -> mean and log std of a squashed Gaussian."""

    network: Network
    offset: Float[Array, " observation"]
    scale: Float[Array, " observation"]

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        hidden: tuple[int, ...],
        *,
        key: PRNGKeyArray,
        offset: np.ndarray | Array | None = None,
        scale: np.ndarray | Array | None = None,
    ) -> None:
        self.network = Network(observation_size, 2 * action_size, hidden, key=key)
        self.offset = jnp.zeros(observation_size) if offset is None else jnp.asarray(offset, jnp.float32)
        self.scale = jnp.ones(observation_size) if scale is None else jnp.asarray(scale, jnp.float32)

    def distribution(
        self, observation: Float[Array, "*rows observation"]
    ) -> tuple[Float[Array, "*rows action"], Float[Array, "*rows action"]]:
        """Mean and log std before squashing."""
        seen = standardise(observation, self.offset, self.scale)
        mean, log_std = jnp.split(self.network(seen), 2, axis=-1)
        return mean, jnp.clip(log_std, *LOG_STD_RANGE)

    def __call__(
        self, observation: Float[Array | np.ndarray, "*rows observation"], key: PRNGKeyArray | None = None
    ) -> Float[Array, "*rows action"]:
        """A sampled action with a key, tanh of the mean without."""
        mean, log_std = self.distribution(jnp.asarray(observation, jnp.float32))
        return jnp.tanh(mean) if key is None else sample(mean, log_std, key)[0]
