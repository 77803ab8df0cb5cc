"""The posterior of a round: what the log's moments, read as those of simulated rows are, say of the parameters."""

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

from madoc.calibration.baselines.npe.moments import Points, Reader, Sets, errors_of, less_noisy
from madoc.learning.networks import Scalar, adam, minimise

HELD_OUT = 0.2
"""Share of the draws by whose likelihood the flow's training is stopped."""
_PIECES = 8
"""Pieces of the flow's training, after each of which it is judged."""
_BATCH = 64
"""Draws in an update."""
_FARTHEST = 3.0
"""Largest standardised statistic that the flow is asked for: beyond, it has seen nothing."""
UNLIKELY = 0.95
"""The estimate is doubted where so large a share of simulated sets is nearer to its parameters than the log to it."""
AS_WIDE = 0.9
"""A posterior whose deviation is this share of the prior's is no narrower than it."""
PRIOR_STD = 1.0 / np.sqrt(3.0)
"""Standard deviation of a value that is uniform in [-1, 1]."""
_TAIL = 0.005
"""Share of the posterior that proposals leave out at either end of each parameter, before they are widened."""


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


@cache
def fresh_flow(count: int, layers: int, width: int) -> Transformed:
    """An untrained masked autoregressive flow (Papamakarios et al. 2017) of `count` values given as many.

    It is made once: another one, though equal, has functions of its own, and JAX would trace its training again.
    """
    with _promoting():
        return masked_autoregressive_flow(
            jax.random.key(0), base_dist=Normal(jnp.zeros(count)), cond_dim=count, flow_layers=layers, nn_width=width
        )


def fitted_flow(
    flow: Transformed, residuals: Points, conditions: Points, key: PRNGKeyArray, *, updates: int, learning_rate: float
) -> Transformed:
    """The flow of residuals given conditions: of all pieces of its training, the best on draws held out."""
    rows = tuple(jnp.asarray(part, jnp.float32) for part in (residuals, conditions))
    held = max(1, round(HELD_OUT * len(residuals)))
    apart, kept = (tuple(part[some] for part in rows) for some in (slice(held), slice(held, None)))
    state = adam(learning_rate).init(eqx.filter(flow, eqx.is_inexact_array))
    best, lowest = flow, float(negative_log_likelihood(flow, *apart))
    for piece in range(_PIECES):
        piece_key = jax.random.fold_in(key, piece)
        flow, state = _train(flow, state, kept, piece_key, learning_rate, -(-updates // _PIECES))
        loss = float(negative_log_likelihood(flow, *apart))
        if loss < lowest:
            best, lowest = flow, loss
    return best


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
    rows: tuple[Float[Array, "rows d"], ...],
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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Belief:
    """What is believed of the parameters, scaled to [-1, 1] of their ranges.

    Attributes:
        interval: Its 95 % interval, columns low and high.
        misfit: Distance of the log's moments from those at the point that they are read as.
        usual_misfit: The distance that a share `UNLIKELY` of the simulated sets stays within.
        rounds: How many posteriors there were.
    """

    mean: Float[np.ndarray, " d"]
    covariance: Float[np.ndarray, "d d"]
    interval: Float[np.ndarray, "d 2"]
    misfit: float
    usual_misfit: float
    rounds: int


def prior_belief(count: int) -> Belief:
    """The uniform box, before there is any posterior."""
    ones = np.ones(count)
    return Belief(0.0 * ones, np.diag(PRIOR_STD**2 * ones), np.stack([-ones, ones], axis=-1), 0.0, 0.0, 0)


def belief_of(samples: Float[np.ndarray, "samples d"], misfit: float, usual_misfit: float, rounds: int) -> Belief:
    """The belief that samples of the posterior stand for."""
    count = samples.shape[1]
    covariance = np.cov(samples, rowvar=False).reshape(count, count)
    interval = np.quantile(samples, [0.025, 0.975], axis=0).T
    return Belief(samples.mean(0), covariance, interval, misfit, usual_misfit, rounds)


def posterior_samples(
    halves: Sets,
    points: Points,
    logged: Sets,
    key: PRNGKeyArray,
    *,
    layers: int,
    width: int,
    updates: int,
    learning_rate: float,
    count: int,
) -> tuple[Float[np.ndarray, "samples d"], float, float]:
    """Samples of the posterior given the log's moments, the log's misfit and the usual one.

    Draws are read as if the log had been recorded under them: its slopes times the point, and the error that their own
    rows show. Each draw's rows come in two `halves`, which differ by sampling noise alone. The flow has `layers` of so
    many units (`width`).
    """
    of_training, of_samples = jax.random.split(key)
    sets = halves.joined(1)
    errors = errors_of(sets, points)
    reader = Reader.of(logged.slopes, errors)
    as_logged = points @ logged.slopes.T + errors
    apart = reader.statistic(errors_of(halves, np.repeat(points[:, None], 2, axis=1)))
    off = (apart[:, 0] - apart[:, 1]) / 2.0
    share = min(1.0, float(sets.rows.mean() / logged.rows))
    statistics = less_noisy(reader.statistic(as_logged), points, off.T @ off / len(off), share)
    regression, statistic = Regression.of(statistics, points), reader.statistic(logged.values)
    flow = fitted_flow(
        fresh_flow(points.shape[1], layers, width),
        regression.residuals(statistics, points),
        regression.condition(statistics),
        of_training,
        updates=updates,
        learning_rate=learning_rate,
    )
    condition = np.clip(regression.condition(statistic), -_FARTHEST, _FARTHEST)
    residuals = _sample(flow, jnp.asarray(condition, jnp.float32), of_samples, count)
    samples = regression.points(statistic, np.asarray(residuals, np.float64))
    usual = float(np.quantile(reader.misfit(as_logged), UNLIKELY))
    return samples, float(reader.misfit(logged.values)), usual


def truncated_box(
    samples: Float[np.ndarray, "samples d"], widening: float, smallest_half: float
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """Ends of the box about nearly all samples, `widening` times as wide, in [-1, 1].

    Where proposals are the prior cut off to where the posterior is, the density of their draws is the posterior's
    without any correction (Deistler et al. 2022). A wider box finds back what was cut off wrongly.
    """
    low, high = np.quantile(samples, [_TAIL, 1.0 - _TAIL], axis=0)
    half = np.clip(widening * (high - low) / 2.0, smallest_half, 1.0)
    middle = np.clip((low + high) / 2.0, half - 1.0, 1.0 - half)
    return middle - half, middle + half


def doubts(belief: Belief, names: tuple[str, ...]) -> tuple[str, ...]:
    """Why the estimate has not settled, a sentence each."""
    if not belief.rounds:
        return (
            "npe has simulated too little for a posterior, and the estimate is the middle of every range: give it a "
            "larger budget",
        )
    sentences = []
    if belief.misfit > belief.usual_misfit:
        sentences.append(
            f"the log is farther from the estimate's simulations than {100 * UNLIKELY:g} % of simulations are from "
            "those of their own parameters: the model lacks something, or the clone does not act as the logged policy"
        )
    deviations = np.sqrt(np.diag(belief.covariance))
    wide = [name for name, std in zip(names, deviations, strict=True) if std > AS_WIDE * PRIOR_STD]
    if wide:
        sentences.append(f"the posterior is as wide as the range of {', '.join(wide)}: the log says nothing of it")
    return tuple(sentences)
