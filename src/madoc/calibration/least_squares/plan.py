"""What a search knows before and after a step: the same whether windows' initial states are known or not."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from madoc.identification.losses import ALL_FAILED

TRIALS = (1e-2, 1.0, 1e2)
"""Factors of the last damping that helped, tried at once; where none helps, the next are a thousand times larger."""
FIRST_DAMPING = 1e-2
"""Relative damping of the first steps."""
_SMALLEST = 1e-100


@dataclass(frozen=True)
class Plan:
    """What residuals and derivatives around a point tell.

    Attributes:
        unit: The point, in [-1, 1].
        residuals: Of each window there, over `deviation`.
        kept: Windows that move the parameters.
        steps: Of the parameters, one for each of `TRIALS`; the last is none.
        state_steps: Of unknown initial states along with each of these, in units of their spread.
        scale: c of the loss.
        deviation: Noise of each channel, in its typical changes.
        bread: Curvature of the cost.
        meat: Scatter of its gradient.
        autocorrelation: Of residuals of consecutive readings.
        exact: Whether residuals are rounding errors, or cannot tell that initial states have yet to move.
        left_out: Share of the windows that the cost does not count.
        failures: Simulations that failed.
    """

    unit: Float[np.ndarray, " d"]
    residuals: Float[np.ndarray, "windows values"]
    kept: Bool[np.ndarray, " windows"]
    steps: Float[np.ndarray, "trials d"]
    state_steps: Float[np.ndarray, "trials unknown physical"]
    scale: float
    deviation: Float[np.ndarray, " channels"]
    bread: Float[np.ndarray, "d d"]
    meat: Float[np.ndarray, "d d"]
    autocorrelation: float
    exact: bool
    left_out: float
    failures: int

    def comparable(self, cost: float) -> float:
        """A cost in typical changes, by which searches are compared; a window left out adds a whole change."""
        return ALL_FAILED if self.left_out == 1.0 else cost * float(self.deviation[0]) ** 2 + self.left_out


@dataclass(frozen=True)
class Outcome:
    """What the steps tried would lead to.

    Attributes:
        before: Cost where they begin.
        totals: Cost after each step; the last is without one of the parameters.
        followed: Share of the state's step that fits each window with an unknown one best.
        failures: Simulations that failed.
    """

    before: float
    totals: Float[np.ndarray, " trials"]
    followed: Float[np.ndarray, "trials unknown"]
    failures: int

    def saved(self, trial: int) -> float:
        """Share of the cost that a step saves."""
        return 1.0 - float(self.totals[trial]) / max(self.before, _SMALLEST)
