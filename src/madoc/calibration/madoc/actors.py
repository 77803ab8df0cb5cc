"""Calibration actors: a tanh-Gaussian for each group, over the parameters of that group.

Groups are disjoint and every Gaussian is diagonal, so all actors together are a mean and a log std of each parameter.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from madoc.learning.networks import PerRow, Scalar
from madoc.learning.tanh_gaussian import sample


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Actors:
    """Means and log stds before squashing, both of shape (d,)."""

    mean: Float[Array | np.ndarray, " d"]
    log_std: Float[Array | np.ndarray, " d"]


def initial_actors(count: int) -> Actors:
    """Actors at N(0, 1) before squashing, where the prior starts too (appendix C)."""
    return Actors(jnp.zeros(count), jnp.zeros(count))


def squashed(actors: Actors) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """The actors' deterministic output in [-1, 1], and their deviations there, to first order."""
    mean = np.tanh(np.asarray(actors.mean, np.float64))
    return mean, (1.0 - mean**2) * np.exp(np.asarray(actors.log_std, np.float64))


def draw_parameters(
    actors: Actors, key: PRNGKeyArray, count: int
) -> tuple[Float[Array, "count d"], Float[Array, " count"]]:
    """Draws of all parameters in [-1, 1], and their log densities summed over groups."""
    shape = (count, len(actors.mean))
    mean, log_std = (jnp.broadcast_to(part, shape) for part in (actors.mean, actors.log_std))
    return sample(mean, log_std, key)


def divergence(actors: Actors, prior: Actors) -> Float[Array, " d"]:
    """KL(q || p) of each parameter, in closed form: squashing both by the same map leaves it as it is."""
    variance_ratio = jnp.exp(2.0 * (actors.log_std - prior.log_std))
    shift = ((actors.mean - prior.mean) * jnp.exp(-prior.log_std)) ** 2
    return 0.5 * (variance_ratio + shift - 1.0) - actors.log_std + prior.log_std


def prior_weight(updates: Int[Array, ""], *, time_constant: float, largest: float) -> Scalar:
    """λ_t = min(largest, exp(t / time_constant)) (appendix C: 10 and 2e5)."""
    return jnp.minimum(largest, jnp.exp(updates / time_constant))


def actor_loss(
    value: PerRow, log_density: PerRow, kl: Scalar, *, entropy_weight: float, prior_weight: Scalar | float
) -> Scalar:
    """Eq. (13): α log q - v + λ KL(q || p), averaged over draws; values, densities and KL are sums over groups."""
    return (entropy_weight * log_density - value).mean() + prior_weight * kl
