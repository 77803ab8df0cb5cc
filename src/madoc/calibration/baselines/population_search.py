"""What methods that search by CMA-ES share: state, replayed windows, cost of failed simulations, estimate."""

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.baselines import evolution
from madoc.calibration.baselines.evolution import Evolution
from madoc.calibration.cautions import at_end_of_range
from madoc.identification.windows import Windows, first_rows, windows_at
from madoc.types import Epoch


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SearchState:
    """A search under way, its randomness, and how many simulated rows have exploded."""

    search: Evolution
    key: PRNGKeyArray
    failures: int


def draw_windows(problem: CalibrationProblem, steps: int, count: int, key: PRNGKeyArray) -> Windows:
    """Logged stretches drawn anew, with repetition.

    All candidates of a generation replay the same ones, the next generation others: so few are enough for an order of
    candidates, and over the whole search none of them can be fitted at the cost of the rest.

    Raises:
        MadocError: No state can be rebuilt, or no episode is long enough.
    """
    states, rows = problem.states.exact()
    possible = first_rows(problem.dataset, rows, steps)
    chosen = possible[np.asarray(jax.random.randint(key, (count,), 0, len(possible)))]
    return windows_at(problem.dataset, states[chosen], rows[chosen], steps)


def mean_with_failures(costs: Float[np.ndarray, "candidates windows"]) -> Float[np.ndarray, " candidates"]:
    """Mean cost of each candidate, failures (NaN) included.

    A failure costs the worst seen, and as much more as that is above the best: a candidate gains nothing by failing.
    """
    failed = np.isnan(costs)
    if failed.all():
        return np.zeros(len(costs))
    best, worst = np.nanmin(costs), np.nanmax(costs)
    return np.where(failed, 2.0 * worst - best, costs).mean(-1)


def next_generation(
    state: SearchState,
    candidates: Float[np.ndarray, "population d"],
    costs: Float[np.ndarray, " population"],
    *,
    control_steps: int,
    tolerance: float,
) -> tuple[SearchState, Epoch]:
    """Update the search with the candidates' costs; also the epoch that evaluated them."""
    search = evolution.tell(state.search, candidates, costs)
    metrics = {"cost": float(costs.min()), "deviation": evolution.widest_deviation(search)}
    epoch = Epoch(metrics, control_steps, converged=evolution.settled(search, tolerance))
    return replace(state, search=search), epoch


def estimate_from_search(problem: CalibrationProblem, state: SearchState) -> Estimate:
    """Centre of the search and covariance of its candidates, in physical units."""
    space = problem.simulator.parameters
    half = (space.high - space.low) / 2.0
    covariance = half[:, None] * evolution.spread(state.search) * half
    return Estimate(
        mean=space.to_physical(state.search.mean),
        std=np.sqrt(np.diag(covariance)),
        failures=state.failures,
        warnings=at_end_of_range(state.search.mean, space.names),
        covariance=covariance,
    )
