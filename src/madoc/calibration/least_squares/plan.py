"""What a search computes before and after a step, and what it has found, in the same form for all searches."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from madoc.identification.gauss_newton import TRIALS
from madoc.identification.information import Uncertainty
from madoc.identification.losses import ALL_FAILED

FEWEST = 5
"""Smallest number of windows beyond that of parameters; with fewer, Student's t would widen the intervals much."""
_SMALLEST = 1e-100


@dataclass(frozen=True)
class Plan:
    """Residuals and derivatives around a point, and the steps to try from there.

    Attributes:
        point: The point, in [-1, 1].
        residuals: The residuals of each window there, over `deviation`.
        relative: Weight of each window's residuals, in (0, 1], by which they are multiplied already.
        kept: Windows that move the parameters.
        steps: Steps of the parameters, one for each of `TRIALS`; the last is zero.
        state_steps: Steps of unknown initial states that go with each of these, in units of `spread`.
        spread: Standard deviation of each value of (qpos, qvel) over the log; empty where initial states are known.
        scale: The tuning constant c of the loss.
        deviation: Noise of each channel, in its typical changes.
        bread: Curvature of the cost.
        meat: Scatter of the cost's gradient.
        failures: Number of simulations that failed.
        autocorrelation: Correlation of residuals of consecutive readings.
        exact: Whether residuals are rounding errors, so that their size cannot show whether initial states still move.
        left_out: Share of the windows that the cost does not count.
        tail_cost: Cost with no noise below the rounding of counts; 0 while searching and for known states.
    """

    point: Float[np.ndarray, " d"]
    residuals: Float[np.ndarray, "windows values"]
    relative: Float[np.ndarray, " windows"]
    kept: Bool[np.ndarray, " windows"]
    steps: Float[np.ndarray, "trials d"]
    state_steps: Float[np.ndarray, "trials unknown physical"]
    spread: Float[np.ndarray, " physical"]
    scale: float
    deviation: Float[np.ndarray, " channels"]
    bread: Float[np.ndarray, "d d"]
    meat: Float[np.ndarray, "d d"]
    failures: int
    autocorrelation: float = 0.0
    exact: bool = True
    left_out: float = 0.0
    tail_cost: float = 0.0

    def comparable(self, cost: float) -> float:
        """A cost in typical changes, by which searches are compared; a window left out adds a whole change."""
        return ALL_FAILED if self.left_out == 1.0 else cost * float(self.deviation[0]) ** 2 + self.left_out


@dataclass(frozen=True)
class Found:
    """What a search has found.

    Attributes:
        point: The parameters, in [-1, 1].
        uncertainty: That of the point.
        windows: Number of independent windows that tell it.
        settled: Whether the search has come to its end.
        unlike_noise: Whether residuals have longer tails than noise has, are each like the next, or follow from state
            and action.
        force: Size of random forces in N/√kg (`identification.random_forces`); 0 where none were found.
    """

    point: Float[np.ndarray, " d"]
    uncertainty: Uncertainty
    windows: int
    settled: bool
    unlike_noise: bool
    force: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """The costs after the steps of a plan.

    Attributes:
        before: Cost at the plan's point.
        totals: Cost after each step that was tried; the last has no step of the parameters.
        followed: Share of its initial state's step that fits each window best, where initial states are unknown.
        failures: Number of simulations that failed.
    """

    before: float
    totals: Float[np.ndarray, " trials"]
    followed: Float[np.ndarray, "trials unknown"]
    failures: int

    def with_no_step(self) -> "Outcome":
        """The same with the cost of staying where the plan is, as the last step."""
        return replace(
            self,
            totals=np.append(self.totals, self.before),
            followed=np.concatenate([self.followed, np.zeros_like(self.followed[:1])]),
        )

    def saved(self, trial: int) -> float:
        """Share of the cost that a step saves."""
        return 1.0 - float(self.totals[trial]) / max(self.before, _SMALLEST)

    def chosen(self) -> tuple[int, float]:
        """Index of the step with the smallest cost, the last one for none, and the factor of the damping."""
        last = len(self.totals) - 1
        trial = int(np.argmin(self.totals))
        return (trial, TRIALS[trial]) if self.totals[trial] < self.totals[last] else (last, 1e3)
