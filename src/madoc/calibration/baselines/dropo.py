"""DROPO: CMA-ES over the mean and the deviation of a distribution of parameters.

Tiboni et al. 2023, "DROPO: sim-to-real transfer with offline domain randomization" (arXiv 2201.08434); with an
entropy bonus it is E-DROPO (arXiv 2506.10133).
"""

from dataclasses import dataclass, replace
from typing import Annotated

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from pydantic import Field

from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.baselines.population_search import (
    SearchState,
    begin_search,
    independent_estimate,
    mean_with_failures,
    next_generation,
    replay_residuals,
)
from madoc.calibration.free_rollouts import SensorNoise, noise_deviation
from madoc.types import Count, Epoch, NotNegative, check_hyperparameters

TRUNCATION = 2.0
"""Number of standard deviations at which the parameter distribution is truncated."""
DEVIATIONS = (1e-3, 0.5)
"""Smallest and largest σ in [-1, 1]. The largest is a quarter of a range, as the authors'."""
ENTROPY_WEIGHT = 0.1
"""Weight of the entropy bonus in E-DROPO, relative to the mean log-likelihood of a transition. Chosen here: we do not
know the paper's value."""


def truncated_noise(key: PRNGKeyArray, draws: int, dimensions: int) -> Float[np.ndarray, "draws d"]:
    """Independent standard normal draws truncated at ±2."""
    return np.asarray(jax.random.truncated_normal(key, -TRUNCATION, TRUNCATION, (draws, dimensions)), np.float64)


def parameter_draws(
    mean: Float[np.ndarray, "candidates d"], std: Float[np.ndarray, "candidates d"], noise: Float[np.ndarray, "draws d"]
) -> Float[np.ndarray, "candidates draws d"]:
    """ξ = μ + σ ε, put on the wall where it leaves the box [-1, 1]."""
    return np.clip(mean[:, None] + std[:, None] * noise, -1.0, 1.0)


def residual_variance(
    noise: Float[np.ndarray, " values"], typical_change: Float[np.ndarray, " values"], epsilon: float
) -> Float[np.ndarray, " values"]:
    """ε + 2 σ², in squared typical changes: a residual has the noise of two readings, where it starts and ends.

    It is what a channel hands on of its own noise, which over one short step is about all; what channels hand on to
    each other is left out.
    """
    return epsilon + 2.0 * (noise / typical_change) ** 2


def moments(
    residuals: Float[np.ndarray, "candidates draws rows values"],
) -> tuple[Float[np.ndarray, "candidates rows values"], Float[np.ndarray, "candidates rows values values"]]:
    """Mean and covariance over the draws whose simulation did not fail (NaN), for every row; NaN for fewer than two."""
    valid = np.isfinite(residuals).all(-1, keepdims=True)
    count = valid.sum(1)
    enough = np.where(count > 1, count, np.nan)
    mean = np.where(valid, residuals, 0.0).sum(1) / enough
    off = np.where(valid, residuals - mean[:, None], 0.0)
    covariance = np.einsum("csrv,csrw->crvw", off, off) / (enough - 1.0)[..., None]
    return mean, covariance


def shrunk(
    covariance: Float[np.ndarray, "candidates rows values values"], draws: Int[np.ndarray, "candidates rows"]
) -> Float[np.ndarray, "candidates rows values values"]:
    """(1 - ρ) S + ρ diag(S): of full rank wherever every value varies, with however few draws it was estimated.

    ρ is the oracle-approximating one, eq. (23), Chen et al. 2010 (arXiv 0907.4698), for the correlations, whose target
    is I: values differ in scale, and a common variance would drown the small ones.
    """
    values = covariance.shape[-1]
    scale = np.sqrt(np.einsum("crvv->crv", covariance))
    scale = np.where(scale > 0.0, scale, 1.0)
    squares = ((covariance / scale[..., None] / scale[..., None, :]) ** 2).sum((-1, -2))
    spread = (draws + 1.0 - 2.0 / values) * np.maximum(squares - values, 0.0)
    wanted = (1.0 - 2.0 / values) * squares + values**2
    share = np.minimum(1.0, wanted / np.where(spread > 0.0, spread, wanted))[..., None, None]
    return np.where(np.eye(values, dtype=bool), covariance, (1.0 - share) * covariance)


def negative_log_likelihood(
    mean: Float[np.ndarray, "candidates rows values"],
    covariance: Float[np.ndarray, "candidates rows values values"],
    variance: Float[np.ndarray, " values"],
) -> Float[np.ndarray, "candidates rows"]:
    """-log N(s'; mean, covariance + diag(variance)) of residuals, whose logged value is 0. NaN where the moments are.

    The authors' ε is the same for all values; here a noisy sensor has more.
    """
    values = mean.shape[-1]
    failed = np.isnan(mean).any(-1)
    whole = np.where(failed[..., None, None], np.eye(values), covariance + np.diag(variance))
    centre = np.where(failed[..., None], 0.0, mean)
    distance = (centre * np.linalg.solve(whole, centre[..., None])[..., 0]).sum(-1)
    negative = 0.5 * (values * np.log(2.0 * np.pi) + np.linalg.slogdet(whole)[1] + distance)
    return np.where(failed, np.nan, negative)


def entropy(std: Float[np.ndarray, "candidates d"]) -> Float[np.ndarray, " candidates"]:
    """Shannon entropy of N(μ, diag σ²), in nats: E-DROPO's bonus. Cutting it off changes it by a constant."""
    return 0.5 * np.log(2.0 * np.pi * np.e * std**2).sum(-1)


def distribution_of(
    candidate: Float[np.ndarray, "*candidates both"],
) -> tuple[Float[np.ndarray, "*candidates d"], Float[np.ndarray, "*candidates d"]]:
    """μ and σ of candidates: the first half is μ, the second is log σ scaled to [-1, 1]."""
    count = candidate.shape[-1] // 2
    low, high = np.log(DEVIATIONS)
    return candidate[..., :count], np.exp(low + (candidate[..., count:] + 1.0) / 2.0 * (high - low))


@dataclass(frozen=True)
class Dropo:
    """Maximise the likelihood of logged next states under a distribution of parameters.

    The authors draw 100 parameter vectors for each of a few fixed transitions. Here a generation costs population ·
    draws · transitions control steps: draws are few and the same for all candidates, the covariance over them is
    shrunk, and the few transitions are drawn anew. Residuals are in units of each channel's typical change in a stride,
    and so is ε, to which the variance of the sensors' noise is added.

    Attributes:
        draws: Parameter vectors per candidate, S.
        transitions: Logged rows in a generation.
        epsilon: ε, added to the variance of every channel.
        sensor_noise: Noise of the sensors, which is not to be taken for a spread of parameters, as a share of a step's
            typical change; None estimates it from the log.
        entropy_weight: Weight of E-DROPO's entropy bonus, which keeps σ from collapsing, relative to the mean
            log-likelihood of a transition.
        population: Candidates in a generation; None takes 4 + ⌊3 ln 2d⌋.
        tolerance: Largest deviation of the search, as a share of each range of μ and of log σ, at which it stops;
            0 never stops.
    """

    draws: Annotated[int, Field(ge=2)] = 16
    transitions: Count = 16
    epsilon: Annotated[float, Field(ge=1e-12)] = 1e-4
    sensor_noise: SensorNoise = None
    entropy_weight: NotNegative = 0.0
    population: Annotated[int, Field(ge=4)] | None = None
    tolerance: NotNegative = 1e-4

    def __post_init__(self) -> None:
        check_hyperparameters(self)

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> SearchState:
        """The search about mid-range, σ half-way between its ends on a log scale; see `begin_search`."""
        return begin_search(problem, key, steps=1, dimensions=2 * len(problem.simulator.parameters))

    def step(self, problem: CalibrationProblem, state: SearchState) -> tuple[SearchState, Epoch]:
        """One generation: all draws of all candidates in one batch."""
        of_candidates, of_draws, of_windows, key = jax.random.split(state.key, 4)
        candidates = state.search.ask(of_candidates, self.population)
        mean, std = distribution_of(candidates)
        draws = parameter_draws(mean, std, truncated_noise(of_draws, self.draws, mean.shape[-1]))
        flat = replay_residuals(
            problem, draws.reshape(-1, draws.shape[-1]), of_windows, steps=1, windows=self.transitions
        )
        residuals = flat.reshape(*draws.shape[:2], *flat.shape[1:])
        centre, covariance = moments(residuals)
        noise = noise_deviation(problem, self.sensor_noise, rows=1)
        by_row = negative_log_likelihood(
            centre,
            shrunk(covariance, np.isfinite(residuals).all(-1).sum(1)),
            residual_variance(noise, problem.typical_change, self.epsilon),
        )
        costs = mean_with_failures(by_row) - self.entropy_weight * entropy(std)
        state, epoch = next_generation(
            state,
            candidates,
            costs,
            key,
            control_steps=flat.shape[0] * flat.shape[1],
            failures=int((~np.isfinite(flat).all(-1)).sum()),
            tolerance=self.tolerance,
        )
        spread = float(distribution_of(state.search.mean)[1].mean())
        return state, replace(epoch, metrics=epoch.metrics | {"std": spread})

    def estimate(self, problem: CalibrationProblem, state: SearchState) -> Estimate:
        """μ and σ at the centre of the search, which varies less than its best candidate."""
        return independent_estimate(problem, *distribution_of(state.search.mean), state.failures)
