"""The posterior's density given a statistic: a linear regression, and a normalising flow of what it leaves."""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from flowjax.distributions import Normal, Transformed
from flowjax.flows import masked_autoregressive_flow
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from madoc.calibration.baselines.npe.summaries import Points
from madoc.learning.networks import Scalar, adam, minimise

HELD_OUT = 0.2
"""Share of the draws by whose likelihood the flow's training is stopped."""
_PIECES = 8
"""Pieces of the flow's training, after each of which it is judged."""
_BATCH = 64
"""Draws in an update."""
_FARTHEST = 3.0
"""Largest standardised statistic that the flow is asked for: beyond, it has seen nothing."""


@dataclass(frozen=True)
class Regression:
    """A linear regression of points on statistics, and the Cholesky root of the covariance that it leaves."""

    middle: Float[np.ndarray, " d"]
    slopes: Float[np.ndarray, "d d"]
    root: Float[np.ndarray, "d d"]
    offset: Float[np.ndarray, " d"]
    scale: Float[np.ndarray, " d"]

    @classmethod
    def of(cls, statistics: Points, points: Points) -> "Regression":
        """The least-squares regression."""
        offset, scale, middle = statistics.mean(0), statistics.std(0) + 1e-9, points.mean(0)
        condition = (statistics - offset) / scale
        slopes = np.linalg.lstsq(condition, points - middle, rcond=None)[0]
        errors = points - middle - condition @ slopes
        covariance = errors.T @ errors / max(1, len(errors) - len(slopes) - 1)
        root = np.linalg.cholesky(covariance + 1e-10 * np.eye(len(slopes)))
        return cls(middle, slopes, root, offset, scale)

    def condition(self, statistics: Float[np.ndarray, "*rows d"]) -> Float[np.ndarray, "*rows d"]:
        """Standardised statistics."""
        return (statistics - self.offset) / self.scale

    def residuals(self, statistics: Points, points: Points) -> Points:
        """What the regression leaves of points, whitened."""
        off = points - self.middle - self.condition(statistics) @ self.slopes
        return np.linalg.solve(self.root, off.T).T

    def points(
        self, statistic: Float[np.ndarray, " d"], residuals: Float[np.ndarray, "samples d"]
    ) -> Float[np.ndarray, "samples d"]:
        """The points with these residuals at a statistic."""
        return self.middle + self.condition(statistic) @ self.slopes + residuals @ self.root.T


@dataclass(frozen=True)
class Density:
    """The density of points given a statistic."""

    regression: Regression
    flow: Transformed

    def sample(
        self, statistic: Float[np.ndarray, " d"], key: PRNGKeyArray, count: int
    ) -> Float[np.ndarray, "samples d"]:
        """Points drawn given a statistic."""
        condition = np.clip(self.regression.condition(statistic), -_FARTHEST, _FARTHEST)
        residuals = _sample(self.flow, jnp.asarray(condition, jnp.float32), key, count)
        return self.regression.points(statistic, np.asarray(residuals, np.float64))


@cache
def fresh_flow(count: int, layers: int, width: int) -> Transformed:
    """An untrained masked autoregressive flow (Papamakarios et al. 2017) of `count` values given as many.

    It is made once: another one, though equal, has functions of its own, and JAX would trace its training again.
    """
    with _promoting():
        return masked_autoregressive_flow(
            jax.random.key(0), base_dist=Normal(jnp.zeros(count)), cond_dim=count, flow_layers=layers, nn_width=width
        )


def fitted_density(
    flow: Transformed, statistics: Points, points: Points, key: PRNGKeyArray, *, updates: int, learning_rate: float
) -> Density:
    """The density of points given statistics: of all pieces of the flow's training, the best on draws held out."""
    regression = Regression.of(statistics, points)
    residuals, conditions = (
        jnp.asarray(part, jnp.float32)
        for part in (regression.residuals(statistics, points), regression.condition(statistics))
    )
    held = max(1, round(HELD_OUT * len(points)))
    apart, kept = (residuals[:held], conditions[:held]), (residuals[held:], conditions[held:])
    state = adam(learning_rate).init(eqx.filter(flow, eqx.is_inexact_array))
    best, lowest = flow, float(negative_log_likelihood(flow, *apart))
    for piece in range(_PIECES):
        piece_key = jax.random.fold_in(key, piece)
        flow, state = _train(flow, state, kept, piece_key, learning_rate, -(-updates // _PIECES))
        loss = float(negative_log_likelihood(flow, *apart))
        if loss < lowest:
            best, lowest = flow, loss
    return Density(regression, best)


@eqx.filter_jit
def negative_log_likelihood(
    flow: Transformed, residuals: Float[Array, "rows d"], conditions: Float[Array, "rows d"]
) -> Scalar:
    """Mean of -log q(residual | condition)."""
    with _promoting():
        return -flow.log_prob(residuals, conditions).mean()


@eqx.filter_jit
def _train(
    flow: Transformed,
    state: PyTree,
    rows: tuple[Float[Array, "rows d"], Float[Array, "rows d"]],
    key: PRNGKeyArray,
    learning_rate: float,
    updates: int,
) -> tuple[Transformed, PyTree]:
    def loss_of(flow: Transformed, key: PRNGKeyArray) -> Scalar:
        chosen = jax.random.randint(key, (_BATCH,), 0, len(rows[0]))
        return negative_log_likelihood(flow, rows[0][chosen], rows[1][chosen])

    flow, state, _ = minimise(loss_of, flow, state, key, optimiser=adam(learning_rate), count=updates)
    return flow, state


@eqx.filter_jit
def _sample(flow: Transformed, condition: Float[Array, " d"], key: PRNGKeyArray, count: int) -> Float[Array, "rows d"]:
    with _promoting():
        return flow.sample(key, (count,), condition=condition)


def _promoting() -> AbstractContextManager[None]:
    """FlowJAX adds arrays of unlike rank, which JAX may have been told to refuse."""
    return jax.numpy_rank_promotion("allow")
