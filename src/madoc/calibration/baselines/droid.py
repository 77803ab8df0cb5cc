"""DROID: replay stretches of the log under many parameters, and keep the search's own distribution.

Tsai et al. 2021, "DROID: minimizing the reality gap using single-shot human demonstration" (arXiv 2102.11003). Its
cost adds an L1 and an L2 distance of trajectories; how they are weighed, and over which channels, is not public. Here
every channel is in units of its typical change in one step, and both distances count the same.
"""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.baselines import evolution
from madoc.calibration.baselines.population_search import (
    SearchState,
    draw_windows,
    estimate_from_search,
    mean_with_failures,
    next_generation,
)
from madoc.errors import check_at_least
from madoc.identification.replay import window_residuals
from madoc.identification.windows import first_rows
from madoc.types import Metrics


def trajectory_cost(
    residuals: Float[np.ndarray, "*windows values"], *, absolute: float, squared: float
) -> Float[np.ndarray, "*windows"]:
    """Distance of a replayed trajectory from the logged one: weighted L1 and squared L2, each a mean over values."""
    return absolute * np.abs(residuals).mean(-1) + squared * (residuals**2).mean(-1)


@dataclass(frozen=True)
class Droid:
    """CMA-ES on the distance between logged stretches and their replay from the logged state.

    The authors replay one demonstration; from a long log, a few short stretches are drawn anew for every generation.
    None reaches over the end of an episode.

    Attributes:
        horizon: Control steps of a stretch.
        windows: Stretches a generation.
        absolute: Weight of the L1 distance.
        squared: Weight of the squared L2 distance.
        population: Candidates a generation; None takes 4 + ⌊3 ln d⌋.
        tolerance: Share of each range; it stops once the search is narrower in all of them. 0 never stops.
    """

    horizon: int = 5
    windows: int = 20
    absolute: float = 1.0
    squared: float = 1.0
    population: int | None = None
    tolerance: float = 1e-5

    def __post_init__(self) -> None:
        check_at_least(self, horizon=1, windows=1, population=4, tolerance=0.0, absolute=0.0, squared=0.0)

    @property
    def name(self) -> str:
        """As `madoc methods` lists it."""
        return "droid"

    @property
    def shown(self) -> tuple[str, ...]:
        """Metrics beside the progress bar."""
        return ("cost", "deviation")

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> SearchState:
        """The search about mid-range.

        Raises:
            MadocError: No state can be rebuilt, no episode is long enough, or the next observations are shuffled.
        """
        problem.require_pairs(self.name)
        first_rows(problem.dataset, problem.logged_rows, self.horizon)
        return SearchState(evolution.begin(np.zeros(len(problem.simulator.parameters))), key, 0, 0)

    def step(self, problem: CalibrationProblem, state: SearchState) -> tuple[SearchState, Metrics]:
        """One generation, all candidates in one batch."""
        of_candidates, of_windows, key = jax.random.split(state.key, 3)
        candidates = evolution.ask(state.search, of_candidates, self.population)
        windows = draw_windows(problem, self.horizon, self.windows, of_windows)
        scale = problem.typical_change
        residuals = window_residuals(problem.simulator, windows, candidates, scale)
        by_window = trajectory_cost(residuals, absolute=self.absolute, squared=self.squared)
        costs = mean_with_failures(by_window)
        spent, failures = by_window.size * self.horizon, int(np.isnan(by_window).sum())
        following = next_generation(state, key, candidates, costs, spent=spent, failures=failures)
        return following, {"cost": float(costs.min()), "deviation": evolution.widest_deviation(following.search)}

    def estimate(self, problem: CalibrationProblem, state: SearchState) -> Estimate:
        """The mean of the search, and the covariance of its last candidates: the paper's randomization."""
        return estimate_from_search(problem, state)

    def control_steps(self, state: SearchState) -> int:
        """Simulated control steps so far."""
        return state.control_steps

    def stage(self, state: SearchState) -> str:
        """There is only one."""
        return "calibrating"

    def progress(self, state: SearchState, budget: int) -> float:
        """Share of the control steps."""
        return min(1.0, state.control_steps / budget)

    def converged(self, state: SearchState) -> str | None:
        """A sentence once the search is narrow."""
        return evolution.settled(state.search, self.tolerance)
