"""How sharply a log can determine each parameter at best, before or after any calibration."""

import numpy as np
from jaxtyping import Float
from scipy.stats import norm

from madoc.data.dataset import Dataset
from madoc.identification.gauss_newton import eliminate
from madoc.identification.information import BOX_VARIANCE, CONFIDENCE
from madoc.identification.linearisation import difference_points, linearise
from madoc.identification.replay import Readings, slopes_at, spread_of, window_residuals
from madoc.identification.states import LoggedStates, probing_windows
from madoc.identification.windows import HORIZONS
from madoc.simulation.base import Simulator

WINDOWS = {"exact": 400, "approximate": 64, "unknown": 64}
"""Most windows whose derivatives are taken, by the kind of states; those of all rows are scaled up from them."""
_HARDLY_KNOWN = 0.25
"""Share of the box's variance, from 0 to 1, above which the data has narrowed a direction by less than half."""
_STATE_DAMPING = 1e-9
"""Relative damping of initial states that are eliminated: less than the error of their one-sided differences."""


def expected_half_widths(
    logged: LoggedStates,
    dataset: Dataset,
    simulator: Simulator,
    unit: Float[np.ndarray, " d"],
    noise: Float[np.ndarray, " observation"],
) -> tuple[Float[np.ndarray, " d"], int]:
    """Half of each parameter's 95 % interval in [-1, 1] at best, and the control steps spent.

    The inverse of Fisher's information, as if the noise of every observation were independent, added to what the box
    tells: of single steps from exact states, else of windows whose initial states are eliminated.

    Args:
        logged: The states of the log that was calibrated to.
        dataset: That log.
        simulator: The model.
        unit: Where the derivatives are taken, in [-1, 1].
        noise: Standard deviation of what is compared, a single step or an observation, in its unit.
    """
    exact = logged.kind == "exact"
    windows = probing_windows(
        logged, dataset, simulator, steps=1 if exact else HORIZONS[-1], count=WINDOWS[logged.kind]
    )
    if exact:
        points = difference_points(unit)
        slopes = linearise(points, window_residuals(simulator, windows, points, noise)).jacobian
        spent, share = len(points) * len(windows), len(dataset) / max(1, len(slopes))
    else:
        readings = Readings(
            windows.actions,
            np.zeros((len(windows), windows.steps + 1, logged.measured)),  # derivatives do not depend on them
            noise[: logged.measured],
            spread_of(windows.states[:, : logged.physical_size]),
        )
        (around,) = slopes_at(simulator, readings, unit[None], windows.states[None])
        damping = np.full(len(windows), _STATE_DAMPING)
        slopes = eliminate(around, np.ones_like(around.residuals), damping).reduced.jacobian
        columns = 1 + 2 * len(unit) + logged.physical_size
        spent = columns * len(windows) * windows.steps
        share = len(dataset) / windows.steps / max(1, int(around.whole.sum()))
    flat = slopes.reshape(-1, len(unit))
    information = flat.T @ flat * share + np.eye(len(unit)) / BOX_VARIANCE
    quantile = norm.ppf(0.5 + CONFIDENCE / 2.0)
    return quantile * np.sqrt(np.diag(widened(np.linalg.inv(information)))), spent


def widened(covariance: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """The covariance with directions that the data hardly determines as long as the box allows.

    A direction of several parameters is longer than any of them: along it, each may go through all of its range while
    the normal distribution that stands for the box ends on a ball.
    """
    variances, directions = np.linalg.eigh(covariance)
    longest = np.abs(directions).max(0)
    variances = np.where(variances > _HARDLY_KNOWN * BOX_VARIANCE, variances / longest**2, variances)
    return (directions * variances) @ directions.T
