"""How much of each parameter's range the log leaves open."""

import numpy as np
from jaxtyping import Float

from madoc.calibration.base import CalibrationProblem
from madoc.identification.excitation import expected_half_widths


def half_widths(
    problem: CalibrationProblem, unit: Float[np.ndarray, " d"], noise: Float[np.ndarray, " observation"]
) -> tuple[Float[np.ndarray, " d"], int]:
    """Half of each parameter's 95 % interval in [-1, 1] at best, and the control steps spent.

    Args:
        problem: The rows that were calibrated to.
        unit: Where the derivatives are taken, in [-1, 1].
        noise: Standard deviation of what is compared, a single step or an observation, in typical changes of a step.
    """
    return expected_half_widths(
        problem.states, problem.dataset, problem.simulator, unit, noise * problem.typical_change[: len(noise)]
    )


def open_shares(
    half: Float[np.ndarray, " d"], interval: Float[np.ndarray, "d 2"] | None, width: Float[np.ndarray, " d"]
) -> Float[np.ndarray, " d"]:
    """Share of each range that the 95 % interval covers, at most 1: the method's own, and no less than the best one.

    Args:
        half: Half of the best possible interval in [-1, 1].
        interval: The method's, in physical units, if it has one.
        width: Of each range, in physical units.
    """
    share = half if interval is None else np.maximum(half, (interval[:, 1] - interval[:, 0]) / width)
    return np.minimum(share, 1.0)
