"""DROPO, assembled: CMA-ES over the mean and the deviation of a distribution of parameters.

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
    truncated_noise,
)
from madoc.calibration.baselines.population_search import SearchState, draw_windows, mean_with_failures, next_generation
from madoc.calibration.cautions import at_end_of_range
from madoc.identification.replay import window_residuals
from madoc.identification.windows import first_rows
from madoc.types import Count, Epoch, NotNegative, check_hyperparameters

DEVIATIONS = (1e-3, 0.5)
"""Smallest and largest σ in [-1, 1]. The largest is a quarter of a range, as the authors'."""
ENTROPY_WEIGHT = 0.1
"""E-DROPO's bonus on the mean log-likelihood of a transition, in nats a nat; the paper's own is not known to us."""


def distribution_of(
    candidate: Float[np.ndarray, "*candidates both"],
) -> tuple[Float[np.ndarray, "*candidates d"], Float[np.ndarray, "*candidates d"]]:
    """μ and σ of candidates: the first half is μ, the second places log σ between its limits."""
    count = candidate.shape[-1] // 2
    low, high = np.log(DEVIATIONS)
    return candidate[..., :count], np.exp(low + (candidate[..., count:] + 1.0) / 2.0 * (high - low))


@dataclass(frozen=True)
class Dropo:
    """Maximise the likelihood of logged next states under the next states that a distribution of parameters makes.

    The authors draw 100 parameter vectors for each of a few transitions, always the same. Here a generation costs
    population · draws · transitions control steps: few draws, in antithetic pairs and the same for all candidates, of
    few transitions, drawn anew. Residuals are in units of each channel's typical change in one step, and so is ε.

    Attributes:
        draws: Parameter vectors per candidate, S; even.
        transitions: Logged rows a generation.
        epsilon: ε, added to the variance of every channel.
        entropy_weight: E-DROPO's bonus, against the collapse of σ, beside the mean log-likelihood of a transition.
        population: Candidates a generation; None takes 4 + ⌊3 ln 2d⌋.
        tolerance: Share of each range, of the mean's and of log σ's; it stops once the search is narrower. 0 never.
    """

    draws: Annotated[int, Field(ge=2)] = 10
    transitions: Count = 16
    epsilon: Annotated[float, Field(ge=1e-12)] = 1e-4
    entropy_weight: NotNegative = 0.0
    population: Annotated[int, Field(ge=4)] | None = None
    tolerance: NotNegative = 1e-4

    def __post_init__(self) -> None:
        check_hyperparameters(self)

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> SearchState:
        """The search about mid-range, σ half-way between its ends on a log scale.

        Raises:
            MadocError: No state can be rebuilt, or the next observations are shuffled.
        """
        problem.require_pairs()
        first_rows(problem.dataset, problem.states.exact()[1], 1)
        return SearchState(evolution.begin(np.zeros(2 * len(problem.simulator.parameters))), key, 0)

    def step(self, problem: CalibrationProblem, state: SearchState) -> tuple[SearchState, Epoch]:
        """One generation: all draws of all candidates in one batch."""
        of_candidates, of_draws, of_windows, key = jax.random.split(state.key, 4)
        candidates = evolution.ask(state.search, of_candidates, self.population)
        mean, std = distribution_of(candidates)
        draws = parameter_draws(mean, std, truncated_noise(of_draws, self.draws // 2, mean.shape[-1]))
        windows = draw_windows(problem, 1, self.transitions, of_windows)
        scale = problem.typical_change
        flat = window_residuals(problem.simulator, windows, draws.reshape(-1, draws.shape[-1]), scale)
        residuals = flat.reshape(*draws.shape[:2], *flat.shape[1:])
        by_row = negative_log_likelihood(*moments(residuals), self.epsilon)
        costs = mean_with_failures(by_row) - self.entropy_weight * entropy(std)
        failures = int((~np.isfinite(flat).all(-1)).sum())
        spent = flat.shape[0] * flat.shape[1]
        state = replace(state, key=key, failures=state.failures + failures)
        state, epoch = next_generation(state, candidates, costs, control_steps=spent, tolerance=self.tolerance)
        spread = float(distribution_of(state.search.mean)[1].mean())
        return state, replace(epoch, metrics=epoch.metrics | {"std": spread})

    def estimate(self, problem: CalibrationProblem, state: SearchState) -> Estimate:
        """μ and σ at the centre of the search, which is steadier than its best candidate."""
        space = problem.simulator.parameters
        mean, deviation = distribution_of(state.search.mean)
        std = deviation * (space.high - space.low) / 2.0
        return Estimate(
            mean=space.to_physical(mean),
            std=std,
            failures=state.failures,
            warnings=at_end_of_range(mean, space.names),
            covariance=np.diag(std**2),
        )
