"""DROID: fit replayed windows of the log by CMA-ES, and keep the distribution of the search.

Tsai et al. 2021, "DROID: minimizing the reality gap using single-shot human demonstration" (arXiv 2102.11003). Its
cost adds an L1 and an L2 distance of trajectories; their weights and channels are not public. Here
every channel is in units of its typical change in a stride, and both distances count the same.
"""

from dataclasses import dataclass
from typing import Annotated

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from pydantic import Field

from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.baselines.population_search import (
    SearchState,
    begin_search,
    estimate_from_search,
    mean_with_failures,
    next_generation,
    replay_residuals,
)
from madoc.types import Count, Epoch, NotNegative, check_hyperparameters


def trajectory_cost(
    residuals: Float[np.ndarray, "*windows values"], *, absolute: float, squared: float
) -> Float[np.ndarray, "*windows"]:
    """Distance of a replayed trajectory from the logged one: weighted L1 and squared L2, each a mean over values."""
    return absolute * np.abs(residuals).mean(-1) + squared * (residuals**2).mean(-1)


@dataclass(frozen=True)
class Droid:
    """CMA-ES on the distance between logged windows and their replay from the logged state.

    The authors replay one demonstration; from a long log, a few short windows are drawn anew for every generation.
    None of them goes beyond the end of an episode.

    Attributes:
        horizon: Window length in control steps.
        windows: Windows in a generation.
        absolute: Weight of the L1 distance.
        squared: Weight of the squared L2 distance.
        population: Candidates in a generation; None takes 4 + ⌊3 ln d⌋.
        tolerance: Largest deviation of the search, as a share of each range, at which it stops; 0 never stops.
    """

    horizon: Count = 5
    windows: Count = 20
    absolute: NotNegative = 1.0
    squared: NotNegative = 1.0
    population: Annotated[int, Field(ge=4)] | None = None
    tolerance: NotNegative = 1e-5

    def __post_init__(self) -> None:
        check_hyperparameters(self)

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> SearchState:
        """The search about mid-range, see `begin_search`."""
        return begin_search(problem, key, steps=self.horizon)

    def step(self, problem: CalibrationProblem, state: SearchState) -> tuple[SearchState, Epoch]:
        """One generation, all candidates in one batch."""
        of_candidates, of_windows, key = jax.random.split(state.key, 3)
        candidates = state.search.ask(of_candidates, self.population)
        residuals = replay_residuals(problem, candidates, of_windows, steps=self.horizon, windows=self.windows)
        by_window = trajectory_cost(residuals, absolute=self.absolute, squared=self.squared)
        return next_generation(
            state,
            candidates,
            mean_with_failures(by_window),
            key,
            control_steps=by_window.size * self.horizon,
            failures=int(np.isnan(by_window).sum()),
            tolerance=self.tolerance,
        )

    def estimate(self, problem: CalibrationProblem, state: SearchState) -> Estimate:
        """The mean of the search, and the covariance of its next candidates: the paper's randomization."""
        return estimate_from_search(problem, state)
