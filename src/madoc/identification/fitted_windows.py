"""Windows of a log fitted by a simulator, parameters and initial states, as score tests need them."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from madoc.data.dataset import Dataset
from madoc.data.timescale import stride
from madoc.identification.gauss_newton import Eliminated, damped_step, eliminate, triangular_factors
from madoc.identification.linearisation import WindowSlopes
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
"""Largest number of times that slopes are simulated in a fit, and of Gauss-Newton steps with the same slopes."""
GAIN = 0.01
"""Share of the cost that a step must remove for another one to follow."""
LENGTHS = 4.0 ** -np.arange(4)
"""Lengths of a step that are tried, in whole Gauss-Newton steps."""
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


@dataclass(frozen=True)
class Fit:
    """Parameters and initial states at which windows were simulated.

    Attributes:
        point: Parameters in [-1, 1].
        states: The initial state of each window.
        slopes: The residuals there, and derivatives there or near.
        control_steps: Control steps that were simulated to find all that.
    """

    point: Float[np.ndarray, " d"]
    states: Float[np.ndarray, "windows state"]
    slopes: WindowSlopes
    control_steps: int

    @property
    def unexplained(self) -> float:
        """Median over windows of the mean squared residual that no initial state explains; infinite if all failed."""
        if not self.slopes.whole.any():
            return np.inf
        fixed = _eliminated(self.slopes, np.ones_like(self.slopes.residuals)).reduced.residuals[self.slopes.whole]
        return float(np.median((fixed**2).mean(-1)))


def fit_windows(
    simulator: Simulator,
    readings: Readings,
    states: Float[np.ndarray, "windows state"],
    point: Float[np.ndarray, " d"],
) -> Fit:
    """The nearest parameters that explain the windows best, then the initial states that do at these parameters."""
    fit = _sloped(simulator, readings, states, point, 0)
    for _ in range(FITS):
        before = fit.unexplained
        fit = _descended(simulator, readings, fit)
        if fit.unexplained >= (1.0 - GAIN) * before:
            break
        fit = _sloped(simulator, readings, fit.states, fit.point, fit.control_steps)
    for _ in range(FITS):
        before = fit.unexplained
        fit = _with_fitted_states(simulator, readings, fit)
        # Steps of the states change what they cannot explain only where their slopes do not hold.
        if abs(fit.unexplained - before) <= GAIN * before:
            break
        fit = _sloped(simulator, readings, fit.states, fit.point, fit.control_steps)
    return fit


def _sloped(
    simulator: Simulator,
    readings: Readings,
    states: Float[np.ndarray, "windows state"],
    point: Float[np.ndarray, " d"],
    spent: int,
) -> Fit:
    """Residuals and slopes simulated at a point, after so many control steps."""
    (slopes,) = slopes_at(simulator, readings, point[None], states[None])
    columns = 1 + 2 * len(point) + len(readings.spread)
    return Fit(point, states, slopes, spent + columns * len(readings) * readings.steps)


def _descended(simulator: Simulator, readings: Readings, fit: Fit) -> Fit:
    """After Gauss-Newton steps for as long as each gains. All use the slopes given, which cost far more than a step."""
    for _ in range(FITS):
        if not fit.slopes.whole.any():
            break
        before = fit.unexplained
        fit = _stepped(simulator, readings, fit)
        if fit.unexplained >= (1.0 - GAIN) * before:
            break
    return fit


def _stepped(simulator: Simulator, readings: Readings, fit: Fit) -> Fit:
    """After a Gauss-Newton step with the slopes given, of the length that gains most; where none gains, as before."""
    slopes = fit.slopes
    scale = scale_of(slopes.residuals[slopes.whole], "cauchy")
    weights = loss_slope((slopes.residuals / scale) ** 2, "cauchy") * slopes.whole[:, None]
    left = _eliminated(slopes, weights)
    whole_step = damped_step(*triangular_factors(left.reduced, 1.0, "linear"), fit.point, _DAMPING)
    of_states = readings.in_state_units(left.states_step(whole_step), fit.states.shape[1])
    points = fit.point + LENGTHS[:, None] * whole_step
    states = fit.states + LENGTHS[:, None, None] * of_states
    residuals = readings.residuals(simulator, points, states)[:, 0]
    spent = fit.control_steps + len(LENGTHS) * len(readings) * readings.steps
    tried = [Fit(*parts, spent) for parts in zip(points, states, map(slopes.at, residuals), strict=True)]
    return min([replace(fit, control_steps=spent), *tried], key=lambda each: each.unexplained)


def _with_fitted_states(simulator: Simulator, readings: Readings, fit: Fit) -> Fit:
    """With the initial states that explain each window best; outlying readings count little."""
    for _ in range(FITS):
        slopes, states = fit.slopes, fit.states
        if not slopes.whole.any():
            break
        noise = _noise(slopes, readings)
        scaled = slopes.over(noise)
        step = _eliminated(scaled, _weights(scaled)).states_step(np.zeros(len(fit.point)))
        moved = states + readings.in_state_units(step, states.shape[1])
        after = readings.residuals(simulator, fit.point[None], moved[None])[0, 0]
        before, now = _costs(scaled.residuals), _costs(after / noise)
        better = slopes.whole & (now < before)
        kept = replace(slopes, residuals=np.where(better[:, None], after, slopes.residuals))
        spent = fit.control_steps + len(readings) * readings.steps
        fit = Fit(fit.point, np.where(better[:, None], moved, states), kept, spent)
        if before[better].sum() - now[better].sum() <= GAIN * before[slopes.whole].sum():
            break
    return fit


def _eliminated(slopes: WindowSlopes, weights: Float[np.ndarray, "windows values"]) -> Eliminated:
    """Residuals and derivatives without what initial states explain."""
    return eliminate(slopes, weights, np.full(len(slopes.residuals), _STATE_DAMPING))


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
    left = _eliminated(scaled, _weights(scaled)).reduced
    return Products.of(left.residuals, left.jacobian[..., :count], left.jacobian[..., count:])


def _noise(slopes: WindowSlopes, readings: Readings) -> Float[np.ndarray, " values"]:
    """Standard deviation of each value's noise, by what no initial state explains of the residuals."""
    alike = _eliminated(slopes, np.ones_like(slopes.residuals))
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
