"""The losses of H2O (Niu et al. 2022, arXiv 2206.13464), one function an equation."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from madoc.learning.dynamics_ratio import Discriminators, log_dynamics_ratio
from madoc.learning.networks import Observations, PerRow, Scalar
from madoc.learning.sac_losses import TwinCritic

RATIO_RANGE = (1e-5, 1.0)
"""The authors' bounds of the dynamics ratio."""

GAP_RANGE = (1e-30, 10.0)
"""Bounds of the dynamics gap. The authors' lower one, 1e-45, is 0 in float32 on most machines, and has no logarithm."""


def dynamics_ratio(log_ratio: PerRow) -> PerRow:
    """P_real(s'|s, a) / P_simulated(s'|s, a), the weight of a simulated row's Bellman error in Eq. (10), clipped."""
    return jnp.clip(jnp.exp(log_ratio), *RATIO_RANGE)


def dynamics_gap(
    discriminators: Discriminators,
    pair: Float[Array, "rows pair"],
    following: Observations,
    *,
    spread: float,
    samples: int,
    key: PRNGKeyArray,
) -> PerRow:
    """u(s, a) = KL(P_simulated || P_real), Eq. (7): the mean of -log ratio over s' drawn about the simulated one.

    A simulator that is deterministic has no distribution to draw from: like the authors' code, s' is blurred by
    normal noise. The paper's is as wide as the data's states; `spread` is in units of a step's change.
    """
    noise = spread * jax.random.normal(key, (samples, *following.shape))
    drawn = (jnp.broadcast_to(following, noise.shape) + noise).reshape(-1, following.shape[-1])
    repeated = jnp.broadcast_to(pair, (samples, *pair.shape)).reshape(-1, pair.shape[-1])
    log_ratio = log_dynamics_ratio(discriminators, repeated, drawn).reshape(samples, -1)
    return jnp.clip(-log_ratio.mean(0), *GAP_RANGE)


def gap_weighted_value(value: PerRow, gap: PerRow) -> Scalar:
    """Log Σ ω exp Q over simulated rows, ω = u / Σ u: the closed form of Eq. (9), what H2O pushes down."""
    return jax.nn.logsumexp(value + jnp.log(gap) - jnp.log(gap.sum()))


def h2o_loss(
    critic: TwinCritic,
    logged: tuple[Array, Array, PerRow],
    simulated: tuple[Array, Array, PerRow],
    *,
    ratio: PerRow,
    gap: PerRow,
    weight: float,
) -> tuple[Scalar, Scalar]:
    """Eq. (9) and (10), summed over the twins.

    The Bellman error of logged rows, that of simulated rows weighed by the dynamics ratio, and `weight` times the
    regulariser: values of simulated rows pushed down where dynamics differ, values of logged rows up. Squared errors
    count whole, as in the authors' code, to which their weight of 0.01 belongs.

    Args:
        critic: The twins.
        logged: Observation, action and Bellman target of logged rows.
        simulated: The same of simulated rows.
        ratio: Dynamics ratio of each simulated row.
        gap: Dynamics gap of each simulated row.
        weight: β.

    Returns:
        The loss, and the regulariser.
    """
    bellman, regulariser = jnp.zeros(()), jnp.zeros(())
    for of_logged, of_simulated in zip(critic(*logged[:2]), critic(*simulated[:2]), strict=True):
        bellman += jnp.mean((of_logged - logged[2]) ** 2) + jnp.mean(ratio * (of_simulated - simulated[2]) ** 2)
        regulariser += gap_weighted_value(of_simulated, gap) - of_logged.mean()
    return bellman + weight * regulariser, regulariser
