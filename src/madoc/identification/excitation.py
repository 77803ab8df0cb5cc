"""How narrow the confidence interval of each parameter can be at best, before or after any calibration."""

import numpy as np
from jaxtyping import Float

from madoc.data.dataset import Dataset, spread_of
from madoc.identification.gauss_newton import eliminate
from madoc.identification.information import BOX_VARIANCE, NORMAL_95
from madoc.identification.linearisation import difference_points, linearise
from madoc.identification.replay import Readings, slopes_at, window_residuals
from madoc.identification.states import LoggedStates, probing_windows
from madoc.identification.windows import horizons
from madoc.simulation.base import Simulator

SINGLE_STEPS, WINDOWS = 400, 64
"""Largest number of single steps, or of windows, that are differentiated; the result is scaled up to all rows."""
_HARDLY_NARROWED = 0.25
"""Share in [0, 1] of the box's variance; above it the data has narrowed a direction by less than half."""


def expected_half_widths(
    logged: LoggedStates,
    dataset: Dataset,
    simulator: Simulator,
    point: Float[np.ndarray, " d"],
    noise: Float[np.ndarray, " observation"],
    *,
    exact: bool,
    most: int = WINDOWS,
) -> Float[np.ndarray, " d"]:
    """Half of each parameter's smallest possible 95 % interval in [-1, 1].

    It is computed from the Fisher information at `point`, as if the noise of all observations were independent, plus
    the prior information of the box: of single steps from logged states if these are `exact`, else of windows whose
    initial states are eliminated. `noise` is the standard deviation of a single step's residuals where states are
    exact, else of an observation, in its unit. At `most` so many windows are differentiated.
    """
    windows = probing_windows(
        logged,
        dataset,
        simulator,
        steps=1 if exact else horizons(dataset)[-1],
        count=SINGLE_STEPS if exact else most,
    )
    if exact:
        points = difference_points(point)
        slopes = linearise(points, window_residuals(simulator, windows, points, noise)).jacobian
        share = len(dataset) / max(1, len(slopes))
    else:
        readings = Readings(
            windows.actions,
            np.zeros((len(windows), windows.steps + 1, logged.measured)),  # derivatives do not depend on readings
            noise[: logged.measured],
            spread_of(windows.states[:, : logged.physical_size]),
        )
        (around,) = slopes_at(simulator, readings, point[None], windows.states[None])
        slopes = eliminate(around, np.ones_like(around.residuals)).reduced.jacobian
        share = len(dataset) / windows.steps / max(1, int(around.whole.sum()))
    flat = slopes.reshape(-1, len(point))
    information = flat.T @ flat * share + np.eye(len(point)) / BOX_VARIANCE
    return NORMAL_95 * np.sqrt(np.diag(widened(np.linalg.inv(information))))


def widened(covariance: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """The covariance with a larger variance of those directions that the data hardly narrows.

    The prior stands for the box by a ball, but a diagonal of the box is longer than its sides: along a direction of
    several parameters each of them may go through its whole range.
    """
    variances, directions = np.linalg.eigh(covariance)
    longest = np.abs(directions).max(0)
    variances = np.where(variances > _HARDLY_NARROWED * BOX_VARIANCE, variances / longest**2, variances)
    return (directions * variances) @ directions.T
