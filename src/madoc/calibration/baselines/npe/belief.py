"""The posterior of a round: what the log's moments, read as those of simulated rows are, say of the parameters."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.calibration.baselines.npe.flow import fitted_density, fresh_flow
from madoc.calibration.baselines.npe.summaries import Points, Reader, Sets, errors_of, less_noisy

UNLIKELY = 0.95
"""The estimate is doubted where so large a share of simulated sets is nearer to its parameters than the log to it."""
AS_WIDE = 0.9
"""A posterior whose deviation is this share of the prior's is no narrower than it."""
PRIOR_STD = 1.0 / np.sqrt(3.0)
"""Standard deviation of a value that is uniform in [-1, 1]."""
_TAIL = 0.005
"""Share of the posterior that proposals leave out at either end of each parameter, before they are widened."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Belief:
    """What is believed of the parameters, scaled to [-1, 1] of their ranges.

    Attributes:
        mean: Mean of the posterior.
        covariance: Its covariance.
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
    rows show. Each draw's rows come in two halves, which differ by sampling noise alone.

    Args:
        halves: Moments of each draw's two halves.
        points: The draws.
        logged: Moments of the log.
        key: Draws batches and samples.
        layers: Layers of the flow.
        width: Units of a layer.
        updates: Updates of the flow.
        learning_rate: Their rate.
        count: Number of samples.
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
    flow = fresh_flow(points.shape[1], layers, width)
    density = fitted_density(flow, statistics, points, of_training, updates=updates, learning_rate=learning_rate)
    samples = density.sample(reader.statistic(logged.values), of_samples, count)
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
