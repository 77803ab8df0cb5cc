"""Windows of a log fitted by a simulator, parameters and initial states, as score tests need them."""

import numpy as np
from jaxtyping import Float

from madoc.data.dataset import Dataset
from madoc.data.timescale import stride
from madoc.identification.gauss_newton import damped_step, eliminate, triangular_factors
from madoc.identification.linearisation import DIFFERENCE, WindowSlopes, difference_points, slopes_of_windows
from madoc.identification.losses import TUNING, loss_slope, loss_value, scale_of
from madoc.identification.noise import channel_noise
from madoc.identification.replay import Readings, slopes_at
from madoc.identification.score_tests import Products
from madoc.identification.states import LoggedStates
from madoc.identification.windows import disjoint_windows, evenly, longest_fit
from madoc.simulation.base import Simulator

WINDOWS = 120
"""Largest number of windows that are simulated; their standard errors vary by about 10 % with so many."""
STRIDES = 20
"""Length of a window in strides: in longer ones small errors of the model grow beyond their slopes."""
NEGLIGIBLE = 1e-5
"""Residual in typical changes of a step; below it there is nothing to explain."""
FITS = 4
"""Largest number of Gauss-Newton steps of parameters and initial states, from the estimate and from logged states."""
GAIN = 0.01
"""Share of the cost that a step must remove for another one to follow."""
_STATE_DAMPING = 1e-9
"""Relative damping of initial states, far below the rounding of their differences."""
_DAMPING = 1e-6
"""Relative damping of a step of the parameters."""


def windows_of(
    dataset: Dataset, logged: LoggedStates, scale: Float[np.ndarray, " observation"], *, fewest: int
) -> tuple[Readings, Float[np.ndarray, "windows state"], Float[np.ndarray, "windows action"]]:
    """Windows that share no observation, guesses of their initial states, and the actions before them.

    They are shorter than `STRIDES` where the log has not enough rows for `fewest` of that length.
    """
    affordable = max(stride(dataset), len(dataset) // fewest - 2)
    steps = longest_fit(dataset, logged.rows, min(STRIDES * stride(dataset), affordable))
    later = logged.rows > dataset.episode_starts[dataset.episode_of(logged.rows)]
    rows, states = logged.rows[later], logged.states[later]
    chosen = evenly(disjoint_windows(dataset, rows, steps), WINDOWS) if len(rows) else np.zeros(0, np.int64)
    readings = Readings.at(dataset, logged, rows[chosen], steps, scale)
    return readings, states[chosen], np.asarray(dataset.transitions.action, np.float64)[rows[chosen] - 1]


def refitted(
    simulator: Simulator,
    readings: Readings,
    states: Float[np.ndarray, "windows state"],
    point: Float[np.ndarray, " d"],
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "windows state"]]:
    """The nearest parameters that explain the windows best, those given if no step of the search helps; and states."""
    damping, least = np.full(len(readings), _STATE_DAMPING), np.inf
    best = (point, states)
    for _ in range(FITS):
        (around,) = slopes_at(simulator, readings, point[None], states[None])
        if not around.whole.any():
            break
        fixed = eliminate(around, np.ones_like(around.residuals), damping).reduced.residuals[around.whole]
        cost = float(np.median((fixed**2).mean(-1)))
        enough = cost >= (1.0 - GAIN) * least
        if cost < least:
            best, least = (point, states), cost
        if enough:
            break
        scale = scale_of(around.residuals[around.whole], "cauchy")
        weights = loss_slope((around.residuals / scale) ** 2, "cauchy") * around.whole[:, None]
        left = eliminate(around, weights, damping)
        step = damped_step(*triangular_factors(left.reduced, 1.0, "linear"), point, _DAMPING)
        states = states + readings.in_state_units(left.states_step(step), states.shape[1])
        point = point + step
    return best


def with_fitted_states(
    simulator: Simulator,
    readings: Readings,
    states: Float[np.ndarray, "windows state"],
    point: Float[np.ndarray, " k"],
) -> Float[np.ndarray, "windows state"]:
    """The initial states that explain each window best at these parameters; outlying readings count little."""
    for _ in range(FITS):
        (around,) = slopes_at(simulator, readings, point[None], states[None], parameters=False)
        noise = _noise(around, readings)
        scaled = around.over(noise)
        fit = eliminate(scaled, _weights(scaled), np.full(len(readings), _STATE_DAMPING))
        moved = states + readings.in_state_units(fit.states_step(np.zeros(0)), states.shape[1])
        after = readings.residuals(simulator, point[None], moved[None])[0, 0]
        before, now = _costs(scaled.residuals), _costs(after / noise)
        better = around.whole & (now < before)
        states = np.where(better[:, None], moved, states)
        if before[better].sum() - now[better].sum() <= GAIN * before[around.whole].sum():
            break
    return states


def slopes_by_calibrated(
    wide: Simulator,
    readings: Readings,
    at: Float[np.ndarray, " k"],
    states: Float[np.ndarray, "windows state"],
    count: int,
) -> WindowSlopes:
    """Residuals and their derivatives by the calibrated parameters and the initial states."""
    points = np.concatenate(
        [difference_points(at[:count]), np.broadcast_to(at[count:], (1 + 2 * count, len(at) - count))], axis=1
    )
    by_points = readings.residuals(wide, points, np.repeat(states[None], len(points), axis=0))[:, 0]
    shift = readings.in_state_units(DIFFERENCE * np.eye(len(readings.spread)), states.shape[1])
    by_shifts = readings.residuals(wide, at[None], (states + shift[:, None]).reshape(1, -1, states.shape[1]))[0]
    return slopes_of_windows(points[:, :count], by_points, by_shifts)


def products_of(slopes: WindowSlopes, readings: Readings, count: int) -> Products | None:
    """Products of residuals and derivatives that no initial state explains; None if there is nothing to explain.

    They are in units of the noise, and residuals far beyond it, as where a contact begins, count little.
    """
    finite = slopes.whole & np.isfinite(slopes.by_parameters).all((1, 2))
    if not finite.any() or np.abs(slopes.residuals[finite]).max() < NEGLIGIBLE:
        return None
    kept = WindowSlopes(
        slopes.residuals[finite], slopes.by_parameters[finite], slopes.by_states[finite], slopes.whole[finite]
    )
    scaled = kept.over(_noise(kept, readings))
    left = eliminate(scaled, _weights(scaled), np.full(len(scaled.residuals), _STATE_DAMPING)).reduced
    return Products.of(left.residuals, left.jacobian[..., :count], left.jacobian[..., count:])


def _noise(slopes: WindowSlopes, readings: Readings) -> Float[np.ndarray, " values"]:
    """Standard deviation of each value's noise, by what no initial state explains of the residuals."""
    alike = eliminate(slopes, np.ones_like(slopes.residuals), np.full(len(slopes.residuals), _STATE_DAMPING))
    shape = (len(slopes.residuals), readings.steps + 1, len(readings.scale))
    left = alike.reduced.residuals[:, : shape[1] * shape[2]]
    noise = channel_noise(left.reshape(shape)[slopes.whole], alike.spare.reshape(shape)[slopes.whole])
    return np.tile(noise, shape[1])


def _weights(slopes: WindowSlopes) -> Float[np.ndarray, "windows values"]:
    """Weights of residuals in units of the noise, by Cauchy's loss."""
    return loss_slope((slopes.residuals / TUNING["cauchy"]) ** 2, "cauchy") * slopes.whole[:, None]


def _costs(residuals: Float[np.ndarray, "windows values"]) -> Float[np.ndarray, " windows"]:
    """Mean loss of each window's residuals in units of the noise; infinite where its simulation failed."""
    with np.errstate(over="ignore", invalid="ignore"):
        cost = loss_value((residuals / TUNING["cauchy"]) ** 2, "cauchy").mean(-1)
    return np.where(np.isfinite(cost), cost, np.inf)
