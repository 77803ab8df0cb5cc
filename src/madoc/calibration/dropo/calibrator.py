"""DROPO, assembled: CMA-ES over the mean and the deviation of a distribution of parameters.

Tiboni et al. 2023 (arXiv 2201.08434); with an entropy bonus, E-DROPO (arXiv 2506.10133).
"""

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.calibration import evolution
from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.cautions import at_end_of_range, exploded
from madoc.calibration.dropo.likelihood import (
    entropy,
    moments,
    negative_log_likelihood,
    parameter_draws,
    truncated_noise,
)
from madoc.calibration.evolution import Evolution
from madoc.calibration.window_residuals import window_residuals
from madoc.data.windows import first_rows, windows_at
from madoc.errors import check_at_least
from madoc.types import Metrics

DEVIATIONS = (1e-3, 0.5)
"""Smallest and largest σ in [-1, 1]; the largest is a quarter of a range."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DropoState:
    """Everything DROPO carries. The search runs over (μ, log σ), both mapped to [-1, 1]."""

    search: Evolution
    key: PRNGKeyArray
    rows_key: PRNGKeyArray
    control_steps: int
    failures: int


@dataclass(frozen=True)
class Dropo:
    draws: int = 10
    transitions: int = 16
    horizon: int = 1
    epsilon: float = 1e-4
    entropy_weight: float = 0.0
    population: int | None = None
    tolerance: float = 1e-4
    fresh: bool = True
    tau0: float = 0.0

    @property
    def name(self) -> str:
        """As `madoc methods` lists it."""
        return "e-dropo" if self.entropy_weight else "dropo"

    @property
    def shown(self) -> tuple[str, ...]:
        """Metrics beside the progress bar."""
        return ("cost", "deviation")

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> DropoState:
        problem.require_pairs(self.name)
        rows_key, key = jax.random.split(key)
        count = len(problem.simulator.parameters)
        first_rows(problem.dataset, problem.logged_rows, self.horizon)
        return DropoState(
            search=evolution.begin(np.append(np.zeros(count), np.full(count, self.tau0))),
            key=key,
            rows_key=rows_key,
            control_steps=0,
            failures=0,
        )

    def step(self, problem: CalibrationProblem, state: DropoState) -> tuple[DropoState, Metrics]:
        of_candidates, of_draws, of_rows, key = jax.random.split(state.key, 4)
        population = self.population or evolution.population_of(len(state.search.mean))
        candidates = evolution.ask(state.search, of_candidates, population)
        mean, std = distribution_of(candidates)
        noise = truncated_noise(of_draws, self.draws // 2, mean.shape[1])
        draws = parameter_draws(mean, std, noise)
        possible = first_rows(problem.dataset, problem.logged_rows, self.horizon)
        order = np.asarray(jax.random.randint(of_rows if self.fresh else state.rows_key, (self.transitions,), 0, len(possible)))
        chosen = possible[order]
        windows = windows_at(problem.dataset, problem.logged_states[chosen], problem.logged_rows[chosen], self.horizon)
        residuals = window_residuals(
            problem.simulator, windows, draws.reshape(-1, draws.shape[-1]), problem.scalings["standardised"].next_scale
        ).reshape(*draws.shape[:2], len(chosen), -1)
        by_row = negative_log_likelihood(*moments(residuals), self.epsilon)
        costs = evolution.mean_with_failures(by_row) - self.entropy_weight * entropy(std)
        following = replace(
            state,
            search=evolution.tell(state.search, candidates, costs),
            key=key,
            control_steps=state.control_steps + draws.shape[0] * draws.shape[1] * len(chosen) * self.horizon,
            failures=state.failures + int((~np.isfinite(residuals).all(-1)).sum()),
        )
        return following, {
            "cost": float(costs.min()),
            "deviation": evolution.widest_deviation(following.search),
            "std": float(distribution_of(following.search.mean)[1].mean()),
        }

    def estimate(self, problem: CalibrationProblem, state: DropoState) -> Estimate:
        space = problem.simulator.parameters
        unit, deviation = distribution_of(state.search.mean)
        std = deviation * (space.high - space.low) / 2.0
        return Estimate(
            mean=space.to_physical(unit),
            std=std,
            groups=(tuple(range(len(space))),),
            warnings=(
                *at_end_of_range(unit, space.names),
                *exploded(state.failures, state.control_steps),
            ),
            covariance=np.diag(std**2),
        )

    def control_steps(self, state: DropoState) -> int:
        """Simulated control steps so far."""
        return state.control_steps

    def stage(self, state: DropoState) -> str:
        """There is only one."""
        return "calibrating"

    def progress(self, state: DropoState, budget: int) -> float:
        """Share of the control steps."""
        return min(1.0, state.control_steps / budget)

    def converged(self, state: DropoState) -> str | None:
        """A sentence once the search is narrow."""
        return evolution.settled(state.search, self.tolerance)


def distribution_of(
    candidate: Float[np.ndarray, "*candidates both"],
) -> tuple[Float[np.ndarray, "*candidates d"], Float[np.ndarray, "*candidates d"]]:
    """μ and σ of candidates: the first half is μ, the second says where log σ lies between its ends."""
    count = candidate.shape[-1] // 2
    low, high = np.log(DEVIATIONS)
    return candidate[..., :count], np.exp(low + (candidate[..., count:] + 1.0) / 2.0 * (high - low))
