"""What calibrators that search by CMA-ES share: state, replayed windows, cost of failed simulations, estimate."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem, Estimate, at_end_of_range
from madoc.calibration.baselines import evolution
from madoc.calibration.baselines.evolution import Candidates, Costs, Evolution
from madoc.identification.replay import window_residuals
from madoc.identification.windows import Windows, first_rows, windows_at
from madoc.types import Epoch


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SearchState:
    """The distribution of the search, the random key, and the number of simulated rows that have exploded."""

    search: Evolution
    key: PRNGKeyArray
    failures: int


def begin_search(
    problem: CalibrationProblem, key: PRNGKeyArray, *, steps: int, dimensions: int | None = None
) -> SearchState:
    """A search about the middle of the box, by default of the parameters, whose cost replays windows of the log.

    Raises:
        MadocError: No state can be rebuilt, no episode has `steps` rows, or the next observations are shuffled.
    """
    problem.require_pairs()
    first_rows(problem.dataset, problem.states.exact()[1], steps)
    return SearchState(evolution.begin(np.zeros(dimensions or len(problem.simulator.parameters))), key, 0)


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
    search = evolution.tell(state.search, candidates, costs)
    metrics = {"cost": float(costs.min()), "deviation": evolution.widest_deviation(search)}
    epoch = Epoch(metrics, control_steps, converged=evolution.settled(search, tolerance))
    return SearchState(search, key, state.failures + failures), epoch


def estimate_from_search(problem: CalibrationProblem, state: SearchState) -> Estimate:
    """Centre of the search and covariance of its candidates, in physical units."""
    space = problem.simulator.parameters
    half = (space.high - space.low) / 2.0
    covariance = half[:, None] * evolution.spread(state.search) * half
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
