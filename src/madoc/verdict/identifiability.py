"""Which parameters the log could tell at all: how much a method that wastes nothing could know of each."""

import numpy as np
from jaxtyping import Float

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.linearisation import difference_points, linearise
from madoc.calibration.least_squares.uncertainty import BOX_VARIANCE
from madoc.verdict.prediction import MOST_WINDOWS, evenly

_NORMAL_95 = 1.959964


def half_widths(
    problem: CalibrationProblem, unit: Float[np.ndarray, " d"], noise: Float[np.ndarray, " observation"]
) -> tuple[Float[np.ndarray, " d"], int]:
    """Half of the 95 % interval of each parameter in [-1, 1], at best, and the control steps spent.

    From the slopes of single steps at logged states (Fisher's information, as if every row's noise were its own) on
    top of what the box says.

    Args:
        problem: The rows that were calibrated to.
        unit: Where.
        noise: Of a single step, in steps' changes.
    """
    simulator, scale = problem.simulator, problem.scalings["standardised"].next_scale
    states, actions = problem.probe
    rows = evenly(np.arange(len(states)), MOST_WINDOWS)
    points = difference_points(unit)
    shape = (len(points), len(rows), -1)
    state, action = (np.broadcast_to(part[rows], (len(points), *part[rows].shape)) for part in (states, actions))
    system = simulator.bind(simulator.parameters.to_physical(points))
    start = system.unbiased(np.ascontiguousarray(state).reshape(shape))
    seen = system.observe(system.step(start, np.ascontiguousarray(action).reshape(shape))) / (scale * noise)
    around = linearise(points, seen)
    slopes = around.jacobian.reshape(-1, len(unit))
    share = len(problem.dataset) / max(1, len(around.jacobian))
    information = slopes.T @ slopes * share + np.eye(len(unit)) / BOX_VARIANCE
    return _NORMAL_95 * np.sqrt(np.diag(np.linalg.inv(information))), seen.shape[0] * seen.shape[1]


def told_shares(
    half: Float[np.ndarray, " d"], interval: Float[np.ndarray, "d 2"] | None, width: Float[np.ndarray, " d"]
) -> Float[np.ndarray, " d"]:
    """How much of each range the 95 % interval covers: the method's own where it is wider, at most all of it."""
    share = half if interval is None else np.maximum(half, (interval[:, 1] - interval[:, 0]) / width)
    return np.minimum(share, 1.0)
