"""The losses of conservative Q-learning, CQL(H) (Kumar et al. 2020, arXiv 2006.04779), one function an equation."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from madoc.learning.networks import Actions, Observations, PerRow, Scalar
from madoc.learning.sac_losses import TwinCritic
from madoc.learning.tanh_gaussian import TanhGaussianPolicy, sample


def log_integral(value: Float[Array, "samples rows"], log_density: Float[Array, "samples rows"]) -> PerRow:
    """Log ∫ exp Q(s, a) da per row, from actions of known density (appendix F): log mean exp(Q - log density).

    Any mixture of proposals will do, as each sample alone is an unbiased estimate of the integral. The authors' code
    sums instead of averaging: another constant, the same gradient.
    """
    return jax.nn.logsumexp(value - log_density, axis=0) - jnp.log(float(len(value)))


def proposals(
    policy: TanhGaussianPolicy,
    observation: Observations,
    next_observation: Observations,
    *,
    samples: int,
    key: PRNGKeyArray,
) -> tuple[Float[Array, "proposals rows action"], Float[Array, "proposals rows"]]:
    """`samples` actions each from the uniform distribution, from π(s) and from π(s'), with their log densities."""
    of_uniform, of_here, of_there = jax.random.split(key, 3)

    def drawn(observation: Array, key: PRNGKeyArray) -> tuple[Array, Array]:
        mean, log_std = policy.distribution(observation)
        shape = (samples, *mean.shape)
        return sample(jnp.broadcast_to(mean, shape), jnp.broadcast_to(log_std, shape), key)

    here, there = drawn(observation, of_here), drawn(next_observation, of_there)
    uniform = jax.random.uniform(of_uniform, here[0].shape, minval=-1.0, maxval=1.0)
    flat = jnp.full(here[1].shape, -uniform.shape[-1] * jnp.log(2.0))
    actions = jnp.concatenate([uniform, here[0], there[0]])
    return jax.lax.stop_gradient((actions, jnp.concatenate([flat, here[1], there[1]])))


def conservative_gap(
    critic: TwinCritic,
    observation: Observations,
    action: Actions,
    proposed: tuple[Float[Array, "proposals rows action"], Float[Array, "proposals rows"]],
) -> Scalar:
    """Eq. (4), the term with weight α: mean of log ∫ exp Q(s, a) da - Q(s, a of the data), summed over the twins."""
    actions, log_density = proposed
    repeated = jnp.broadcast_to(observation, (*actions.shape[:2], observation.shape[-1]))
    pairs = zip(critic(repeated, actions), critic(observation, action), strict=True)
    first, second = (jnp.mean(log_integral(value, log_density) - logged) for value, logged in pairs)
    return first + second


def cql_loss(
    critic: TwinCritic,
    observation: Observations,
    action: Actions,
    target: PerRow,
    proposed: tuple[Float[Array, "proposals rows action"], Float[Array, "proposals rows"]],
    *,
    weight: float,
) -> tuple[Scalar, Scalar]:
    """Eq. (4): Bellman error plus `weight` times the gap; also the gap.

    The squared error is not halved as it is in the paper: it is not in the authors' code, to which their weights of 5
    and 10 belong.
    """
    first, second = critic(observation, action)
    bellman = jnp.mean((first - target) ** 2) + jnp.mean((second - target) ** 2)
    gap = conservative_gap(critic, observation, action, proposed)
    return bellman + weight * gap, gap
