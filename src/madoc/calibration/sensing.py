"""What methods are told of the sensors, each the same: their noise, and how many rows tell a state."""

import numpy as np
from jaxtyping import Float

from madoc.calibration.base import CalibrationProblem
from madoc.learning.features import HIDDEN_WINDOW, last_rows
from madoc.types import NotNegative

SensorNoise = NotNegative | None
"""Noise of the sensors relative to a step's typical change; None estimates it from the log."""


def rows_compared(problem: CalibrationProblem) -> int:
    """Rows that are compared at a time: one where it tells a state, or no episode has more, else `HIDDEN_WINDOW`.

    A row alone does not tell which actions are pending, nor a velocity that is a difference of positions.
    """
    of_several = problem.dataset.disturbance.velocities == "differences" or problem.simulator.task.pending
    tells = problem.states.kind == "exact" and not of_several
    return 1 if tells or not len(last_rows(problem.dataset, HIDDEN_WINDOW)) else HIDDEN_WINDOW


def noise_deviation(problem: CalibrationProblem, share: SensorNoise, rows: int) -> Float[np.ndarray, " observation"]:
    """Standard deviation of the noise of observations: as told, or estimated from the log by windows of so many rows.

    What the log declares of its noise is not read: a user's log declares nothing.
    """
    if share is None:
        return problem.noise_of_log(rows)
    # The logged change holds the noise of two readings; the share is that of the change without noise.
    return share / np.sqrt(1.0 + 2.0 * share**2) * problem.row_change
