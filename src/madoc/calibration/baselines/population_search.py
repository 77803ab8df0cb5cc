"""CMA-ES in the box [-1, 1]^d, one generation at a time, and what calibrators that search by it share.

Hansen 2016, "The CMA evolution strategy: a tutorial". The library `cmaes` computes its equations; an optimiser is made
of arrays that a checkpoint can hold in every generation, so that a resumed search is the same search.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem, Estimate, at_end_of_range
from madoc.identification.replay import window_residuals
from madoc.identification.windows import Windows, first_rows, windows_at
from madoc.types import Epoch

if TYPE_CHECKING:
    from cmaes import CMA

FIRST_DEVIATION = 0.5
"""Deviation of the first candidates, in [-1, 1]: a quarter of each range."""
LARGEST_DEVIATION = 2.0
"""Largest deviation of a candidate, the width of the box. The step size of a flat cost grows without limit; beyond this
candidates would only be put on the walls."""

Candidates = Float[np.ndarray, "population d"]
"""Parameters of each candidate of a generation, in [-1, 1]."""
Costs = Float[np.ndarray, " population"]
"""Cost of each candidate of a generation."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Evolution:
    """A normal distribution of candidates, and the evolution paths of CMA-ES.

    Attributes:
        mean: Centre of the next candidates, in [-1, 1].
        deviation: σ, the step size.
        covariance: C; candidates are drawn from N(mean, σ² C), again where they leave the box.
        deviation_path: p_σ.
        covariance_path: p_c.
        generation: Generations done.
    """

    mean: Float[np.ndarray, " d"]
    deviation: float
    covariance: Float[np.ndarray, "d d"]
    deviation_path: Float[np.ndarray, " d"]
    covariance_path: Float[np.ndarray, " d"]
    generation: int

    @classmethod
    def about(cls, mean: Float[np.ndarray, " d"], deviation: float = FIRST_DEVIATION) -> "Evolution":
        """A distribution with equal and independent deviations about a given centre."""
        nothing = np.zeros(len(mean))
        return cls(np.array(mean, np.float64), deviation, np.eye(len(mean)), nothing, nothing, 0)

    def ask(self, key: PRNGKeyArray, population: int | None = None) -> Candidates:
        """The candidates of a generation, by default 4 + ⌊3 ln d⌋ of them (Eq. 48 of the tutorial).

        A candidate outside the box is drawn again, a hundred times at most; then it is put on the wall.
        """
        population = population or 4 + int(3.0 * np.log(len(self.mean)))
        optimiser = self._optimiser(population, seed=int(jax.random.randint(key, (), 0, 2**31 - 1)))
        return np.stack([optimiser.ask() for _ in range(population)])

    def tell(self, candidates: Candidates, costs: Costs) -> "Evolution":
        """The distribution after a generation. Only the order of the costs matters, and the lowest is the best."""
        optimiser = self._optimiser(len(candidates))
        optimiser.tell(list(zip(candidates, costs.tolist(), strict=True)))
        widest = float(np.sqrt(np.diag(optimiser._C).max()))
        return Evolution(
            mean=optimiser.mean,
            deviation=min(float(optimiser._sigma), LARGEST_DEVIATION / widest),
            covariance=optimiser._C,
            deviation_path=optimiser._p_sigma,
            covariance_path=optimiser._pc,
            generation=optimiser.generation,
        )

    @property
    def spread(self) -> Float[np.ndarray, "d d"]:
        """Covariance of the candidates, σ² C, without the box."""
        return self.deviation**2 * self.covariance

    @property
    def widest(self) -> float:
        """The largest deviation of a candidate's coordinate."""
        return float(np.sqrt(np.diag(self.spread).max()))

    def settled(self, tolerance: float) -> str | None:
        """A sentence once every coordinate's deviation, as a share of its range, is below the tolerance; else None."""
        if self.widest / 2.0 >= tolerance:
            return None
        return f"after {self.generation} generations every deviation is below {tolerance:g} of its range"

    def _optimiser(self, population: int, seed: int = 0) -> "CMA":
        """The library's optimiser in this state. It has no public way to set the last three attributes."""
        from cmaes import CMA  # slow to import, and only methods that search by it need it

        optimiser = CMA(
            mean=np.clip(self.mean, -1.0, 1.0),
            sigma=self.deviation,
            bounds=np.tile([-1.0, 1.0], (len(self.mean), 1)),
            population_size=population,
            cov=self.covariance.copy(),
            seed=seed,
        )
        optimiser._p_sigma = self.deviation_path.copy()
        optimiser._pc = self.covariance_path.copy()
        optimiser._g = self.generation
        return optimiser


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SearchState:
    """The distribution of the search, the random key, and the number of simulated rows that have exploded."""

    search: Evolution
    key: PRNGKeyArray
    failures: int = 0


def begin_search(
    problem: CalibrationProblem, key: PRNGKeyArray, *, steps: int, dimensions: int | None = None
) -> SearchState:
    """A search about the middle of the box, by default of the parameters, whose cost replays windows of the log.

    Raises:
        MadocError: No state can be rebuilt, no episode has `steps` rows, or the next observations are shuffled.
    """
    problem.require_pairs()
    first_rows(problem.dataset, problem.states.exact()[1], steps)
    return SearchState(Evolution.about(np.zeros(dimensions or len(problem.simulator.parameters))), key)


def draw_windows(problem: CalibrationProblem, steps: int, count: int, key: PRNGKeyArray) -> Windows:
    """Windows of the log drawn with replacement.

    All candidates of a generation replay the same windows, the next generation replays others. A few windows suffice
    to rank candidates, and over the whole search the estimate cannot be overfitted to any of them.

    Raises:
        MadocError: No state can be rebuilt, or no episode is long enough.
    """
    states, rows = problem.states.exact()
    possible = first_rows(problem.dataset, rows, steps)
    chosen = possible[np.asarray(jax.random.randint(key, (count,), 0, len(possible)))]
    return windows_at(problem.dataset, states[chosen], rows[chosen], steps)


def replay_residuals(
    problem: CalibrationProblem,
    candidates: Float[np.ndarray, "candidates d"],
    key: PRNGKeyArray,
    *,
    steps: int,
    windows: int,
) -> Float[np.ndarray, "candidates windows values"]:
    """Residuals of random windows under each candidate, in typical changes of a stride; NaN where it failed."""
    drawn = draw_windows(problem, steps, windows, key)
    return window_residuals(problem.simulator, drawn, candidates, problem.typical_change)


def mean_with_failures(costs: Float[np.ndarray, "candidates windows"]) -> Float[np.ndarray, " candidates"]:
    """Mean cost of each candidate, where a failed simulation (NaN) costs twice the largest less the smallest cost.

    So no candidate can lower its cost by failing.
    """
    failed = np.isnan(costs)
    if failed.all():
        return np.zeros(len(costs))
    best, worst = np.nanmin(costs), np.nanmax(costs)
    return np.where(failed, 2.0 * worst - best, costs).mean(-1)


def next_generation(
    state: SearchState,
    candidates: Candidates,
    costs: Costs,
    key: PRNGKeyArray,
    *,
    control_steps: int,
    failures: int,
    tolerance: float,
) -> tuple[SearchState, Epoch]:
    """The state after a generation, given its costs and the next random key, and the epoch that evaluated it."""
    search = state.search.tell(candidates, costs)
    metrics = {"cost": float(costs.min()), "deviation": search.widest}
    epoch = Epoch(metrics, control_steps, converged=search.settled(tolerance))
    return SearchState(search, key, state.failures + failures), epoch


def estimate_from_search(problem: CalibrationProblem, state: SearchState) -> Estimate:
    """Centre of the search and covariance of its candidates, in physical units."""
    space = problem.simulator.parameters
    half = (space.high - space.low) / 2.0
    covariance = half[:, None] * state.search.spread * half
    return Estimate(
        mean=space.to_physical(state.search.mean),
        std=np.sqrt(np.diag(covariance)),
        failures=state.failures,
        warnings=at_end_of_range(state.search.mean, space),
        covariance=covariance,
    )


def independent_estimate(
    problem: CalibrationProblem, mean: Float[np.ndarray, " d"], std: Float[np.ndarray, " d"], failures: int
) -> Estimate:
    """Independent parameters of this mean and standard deviation in [-1, 1]."""
    space = problem.simulator.parameters
    physical = std * (space.high - space.low) / 2.0
    return Estimate(
        mean=space.to_physical(mean),
        std=physical,
        failures=failures,
        warnings=at_end_of_range(mean, space),
        covariance=np.diag(physical**2),
    )
