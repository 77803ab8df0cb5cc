"""DROID: replay stretches of the log under many parameters, and keep the search's own distribution.

Tsai et al. 2021, "DROID: minimizing the reality gap using single-shot human demonstration" (arXiv 2102.11003). Its
cost adds an L1 and an L2 distance of trajectories; how they are weighed, and over which channels, is not public. Here
every channel is in units of its typical change in one step, and both distances count the same.
"""

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from madoc.calibration import evolution
from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.cautions import at_end_of_range, exploded
from madoc.calibration.evolution import Evolution
from madoc.calibration.window_residuals import window_residuals
from madoc.data.windows import first_rows, windows_at
from madoc.errors import check_at_least
from madoc.types import Metrics


def trajectory_cost(
    residuals: Float[np.ndarray, "*windows values"], *, absolute: float, squared: float
) -> Float[np.ndarray, "*windows"]:
    """Distance of a replayed trajectory from the logged one: weighted L1 and squared L2, each a mean over values."""
    return absolute * np.abs(residuals).mean(-1) + squared * (residuals**2).mean(-1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DroidState:
    """Everything DROID carries; `chosen` are the rebuilt states that windows begin at."""

    search: Evolution
    chosen: Int[np.ndarray, " windows"]
    key: PRNGKeyArray
    control_steps: int
    failures: int


@dataclass(frozen=True)
class Droid:
    """CMA-ES on the distance between logged stretches and their replay from the logged state.

    The same stretches are replayed in every generation, so candidates of different ones can be compared. No stretch
    reaches over the end of an episode.

    Attributes:
        horizon: Control steps of a stretch.
        windows: Stretches; all there are if fewer.
        absolute: Weight of the L1 distance.
        squared: Weight of the squared L2 distance.
        population: Candidates a generation; None takes 4 + ⌊3 ln d⌋.
        tolerance: Share of each range; it stops once the search is narrower in all of them. 0 never stops.
    """

    horizon: int = 5
    windows: int = 40
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

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> DroidState:
        """Stretches drawn, the search about mid-range.

        Raises:
            MadocError: No state can be rebuilt, no episode is long enough, or the next observations are shuffled.
        """
        problem.require_pairs(self.name)
        of_windows, key = jax.random.split(key)
        possible = first_rows(problem.dataset, problem.logged_rows, self.horizon)
        count = min(self.windows, len(possible))
        order = np.asarray(jax.random.choice(of_windows, len(possible), (count,), replace=False))
        return DroidState(
            search=evolution.begin(np.zeros(len(problem.simulator.parameters))),
            chosen=possible[order],
            key=key,
            control_steps=0,
            failures=0,
        )

    def step(self, problem: CalibrationProblem, state: DroidState) -> tuple[DroidState, Metrics]:
        """One generation, all candidates in one batch."""
        of_candidates, key = jax.random.split(state.key)
        population = self.population or evolution.population_of(len(state.search.mean))
        candidates = evolution.ask(state.search, of_candidates, population)
        rows = problem.logged_rows[state.chosen]
        windows = windows_at(problem.dataset, problem.logged_states[state.chosen], rows, self.horizon)
        scale = problem.scalings["standardised"].next_scale
        residuals = window_residuals(problem.simulator, windows, candidates, scale)
        by_window = trajectory_cost(residuals, absolute=self.absolute, squared=self.squared)
        costs = evolution.mean_with_failures(by_window)
        following = replace(
            state,
            search=evolution.tell(state.search, candidates, costs),
            key=key,
            control_steps=state.control_steps + by_window.size * self.horizon,
            failures=state.failures + int(np.isnan(by_window).sum()),
        )
        return following, {
            "cost": float(costs.min()),
            "deviation": evolution.widest_deviation(following.search),
        }

    def estimate(self, problem: CalibrationProblem, state: DroidState) -> Estimate:
        """The mean of the search, and the covariance of its last candidates: the paper's randomization."""
        space = problem.simulator.parameters
        half = (space.high - space.low) / 2.0
        covariance = half[:, None] * evolution.spread(state.search) * half
        return Estimate(
            mean=space.to_physical(state.search.mean),
            std=np.sqrt(np.diag(covariance)),
            groups=(tuple(range(len(space))),),
            warnings=(
                *at_end_of_range(state.search.mean, space.names),
                *exploded(state.failures, state.control_steps),
            ),
            covariance=covariance,
        )

    def control_steps(self, state: DroidState) -> int:
        """Simulated control steps so far."""
        return state.control_steps

    def stage(self, state: DroidState) -> str:
        """There is only one."""
        return "calibrating"

    def progress(self, state: DroidState, budget: int) -> float:
        """Share of the control steps."""
        return min(1.0, state.control_steps / budget)

    def converged(self, state: DroidState) -> str | None:
        """A sentence once the search is narrow."""
        return evolution.settled(state.search, self.tolerance)
