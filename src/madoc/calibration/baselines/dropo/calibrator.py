"""DROPO: CMA-ES over the mean and the deviation of a distribution of parameters.

Tiboni et al. 2023 (arXiv 2201.08434); with an entropy bonus it is E-DROPO (arXiv 2506.10133).
"""

from dataclasses import dataclass, replace
from typing import Annotated

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from pydantic import Field

from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.baselines import evolution
from madoc.calibration.baselines.dropo.likelihood import (
    entropy,
    moments,
    negative_log_likelihood,
    parameter_draws,
    residual_variance,
    shrunk,
    truncated_noise,
)
from madoc.calibration.baselines.population_search import (
    SearchState,
    begin_search,
    independent_estimate,
    mean_with_failures,
    next_generation,
    replay_residuals,
)
from madoc.calibration.sensing import SensorNoise, noise_deviation
from madoc.types import Count, Epoch, NotNegative, check_hyperparameters

DEVIATIONS = (1e-3, 0.5)
"""Smallest and largest σ in [-1, 1]. The largest is a quarter of a range, as the authors'."""
ENTROPY_WEIGHT = 0.1
"""Weight of the entropy bonus in E-DROPO, relative to the mean log-likelihood of a transition. Chosen here: we do not
know the paper's value."""


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
        candidates = evolution.ask(state.search, of_candidates, self.population)
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
