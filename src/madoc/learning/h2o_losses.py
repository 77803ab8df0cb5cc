"""The losses of H2O (Niu et al. 2022, arXiv 2206.13464), one function an equation."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from madoc.learning.dynamics_ratio import Discriminators, log_dynamics_ratio
from madoc.learning.networks import Observations, PerRow, Scalar
from madoc.learning.sac_losses import TwinCritic

RATIO_RANGE = (1e-5, 1.0)
"""Range to which the dynamics ratio is clipped; the authors'."""
GAP_RANGE = (1e-30, 10.0)
"""Range to which the dynamics gap is clipped. The authors' lower end, 1e-45, is 0 in float32 and has no logarithm."""


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

    A deterministic simulator has no distribution to draw from: as in the authors' code, normal noise is added to s'.
    The paper's noise is as wide as the data's states; `spread` is its deviation in units of a step's change.
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
    """Eq. (9) and (10), summed over the twin critics; also the regulariser.

    The loss is the Bellman error of logged rows, that of simulated rows weighted by their dynamics `ratio`, and
    `weight` (β) times the regulariser: it lowers the values of simulated rows where the dynamics `gap` is large and
    raises those of logged rows. Squared errors are not halved, as in the authors' code, to which their weight of 0.01
    belongs. Rows are (observation, action, Bellman target).
    """
    bellman, regulariser = jnp.zeros(()), jnp.zeros(())
    for of_logged, of_simulated in zip(critic(*logged[:2]), critic(*simulated[:2]), strict=True):
        bellman += jnp.mean((of_logged - logged[2]) ** 2) + jnp.mean(ratio * (of_simulated - simulated[2]) ** 2)
        regulariser += gap_weighted_value(of_simulated, gap) - of_logged.mean()
    return bellman + weight * regulariser, regulariser
