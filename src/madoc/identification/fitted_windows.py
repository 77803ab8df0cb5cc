"""Windows of a log fitted by a simulator, parameters and initial states, as score tests need them."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.data.dataset import Dataset, stride
from madoc.identification.ensembles import with_contacts_settled
from madoc.identification.gauss_newton import (
    DAMPING,
    Eliminated,
    damped_step,
    eliminate,
    explicable,
    left_by,
    left_by_states,
    spare_of,
    triangular_factors,
)
from madoc.identification.linearisation import WindowSlopes
from madoc.identification.losses import TUNING, loss_slope
from madoc.identification.noise import channel_noise
from madoc.identification.replay import Readings, slopes_at
from madoc.identification.score_tests import Products
from madoc.identification.settling import fitted_states
from madoc.identification.states import LoggedStates
from madoc.identification.windows import disjoint_windows, evenly, longest_fit
from madoc.simulation.base import Simulator

WINDOWS = 120
"""Largest number of windows that are simulated, unless more are needed for as many parameters; standard errors vary by
about 10 % with so many."""
STRIDES = 20
"""A window's length in strides; over longer ones derivatives no longer predict what a small error of the model does."""
NOTHING = 1e-5
"""Residual in typical changes of a stride; below it there is nothing to explain."""
NEGLIGIBLE = 1e-3
"""Residual in typical changes of a stride; no sensor is more precise, so smaller ones count as none."""
LINEARISATIONS = 4
"""Largest number of times that derivatives are simulated anew in a fit."""
STEPS = 4
"""Largest number of Gauss-Newton steps with the same derivatives."""
GAIN = 0.01
"""Share of the cost that a step must remove for another one to follow."""
LENGTHS = 4.0 ** -np.arange(4)
"""Lengths of a step that are tried, as shares in [0, 1] of the Gauss-Newton step."""


@dataclass(frozen=True)
class LoggedWindows:
    """Windows of a log that share no observation.

    Attributes:
        readings: What was observed and done in them.
        states: Guesses of their initial states.
        before: The action before each, or its first one where every row is an episode of its own.
        earlier: Logged states before each, of as many rows as it has; the first of its episode where that begins later,
            and none where every row is an episode of its own.
        runs: The episode of each.
        rows: The row at which each begins.
    """

    readings: Readings
    states: Float[np.ndarray, "windows state"]
    before: Float[np.ndarray, "windows action"]
    earlier: Float[np.ndarray, "windows steps state"]
    runs: Int[np.ndarray, " windows"]
    rows: Int[np.ndarray, " windows"]


def windows_of(
    dataset: Dataset,
    logged: LoggedStates,
    scale: Float[np.ndarray, " observation"],
    *,
    fewest: int,
    most: int | None = None,
) -> LoggedWindows:
    """Windows to test a model by, evenly spread over the log.

    They are shorter than `STRIDES` where the log has not enough rows for `fewest` of that length, or where the episode
    of its median row is shorter. Where every row is an episode of its own they are single rows, as many as make up
    those windows, and the action before each, which is not known, is taken to be its own. There are `most` windows at
    most, where that is given.
    """
    lengths = dataset.episode_ends - dataset.episode_starts
    age = logged.rows - dataset.episode_starts[dataset.episode_of(logged.rows)]
    earliest = max(
        1, int(age.min(initial=len(dataset)))
    )  # behind the actions that are pending, and one action at least
    usual = max(1, int(np.median(np.repeat(lengths, lengths))) - earliest)
    affordable = min(max(stride(dataset), len(dataset) // fewest - 2), usual)
    loose = bool(lengths.max() == 1)
    rows, states = logged.rows[loose | (age > 0)], logged.states[loose | (age > 0)]
    steps, chosen = min(STRIDES * stride(dataset), affordable), np.zeros(0, np.int64)
    if len(rows):
        steps = longest_fit(dataset, rows, steps)
        usually = max(WINDOWS * STRIDES if loose else WINDOWS, fewest)
        count = usually if most is None else min(usually, most)
        chosen = evenly(disjoint_windows(dataset, rows, steps), count)
    readings = Readings.at(dataset, logged, rows[chosen], steps, scale)
    runs = dataset.episode_of(rows[chosen])
    acted = np.maximum(rows[chosen] - 1, dataset.episode_starts[runs])
    before = np.asarray(dataset.transitions.action, np.float64)[acted]
    wanted = np.maximum(
        rows[chosen, None] - np.arange(0 if loose else steps, 0, -1), dataset.episode_starts[runs, None]
    )
    earlier = logged.states[np.searchsorted(logged.rows, wanted).clip(max=len(logged.rows) - 1)]
    return LoggedWindows(readings, states[chosen], before, earlier, runs, rows[chosen])


@dataclass(frozen=True)
class Fit:
    """Parameters and initial states at which windows were simulated.

    Attributes:
        point: Parameters in [-1, 1].
        states: The initial state of each window.
        slopes: Residuals at the point and the states, and their derivatives, at the last point where these were
            simulated.
        explicable: Orthonormal columns that span what initial states explain of residuals, to first order there.
        counted: Windows whose simulation succeeded there.
    """

    point: Float[np.ndarray, " d"]
    states: Float[np.ndarray, "windows state"]
    slopes: WindowSlopes
    explicable: Float[np.ndarray, "windows values n"]
    counted: Bool[np.ndarray, " windows"]

    @cached_property
    def left(self) -> Float[np.ndarray, "windows values"]:
        """What no initial state explains of the residuals, to first order."""
        return left_by(self.explicable, self.slopes.residuals)

    @cached_property
    def spare(self) -> Float[np.ndarray, "windows values"]:
        """1 - leverage of each value: the share of its noise that its window's initial state does not absorb."""
        return spare_of(self.explicable)

    @cached_property
    def unexplained(self) -> float:
        """Median over the counted windows of the mean squared residual that no initial state explains.

        It is infinite for a window whose simulation has failed since, and if none is counted.
        """
        if not self.counted.any():
            return np.inf
        return float(np.median(np.where(self.slopes.whole, (self.left**2).mean(-1), np.inf)[self.counted]))

    def gains_on(self, other: "Fit") -> bool:
        """Whether it leaves so much less unexplained than another fit that the search is to go on."""
        return self.unexplained < (1.0 - GAIN) * other.unexplained


def fit_log(
    dataset: Dataset, logged: LoggedStates, simulator: Simulator, windows: LoggedWindows, point: Float[np.ndarray, " d"]
) -> Fit:
    """`fit_windows` from what the log tells of initial states, of which those in contact settle first."""
    readings = windows.readings
    states = with_contacts_settled(dataset, logged, simulator, readings, windows.rows, point, windows.states)
    return fit_windows(simulator, readings, states, point)


def fit_windows(
    simulator: Simulator,
    readings: Readings,
    states: Float[np.ndarray, "windows state"],
    point: Float[np.ndarray, " d"],
    most: int = LINEARISATIONS,
) -> Fit:
    """Parameters and initial states that explain the windows best, from near a given point.

    Steps are those of a robust loss, and are taken while they lower the median window's squared residual.
    Derivatives are simulated anew at most so many times.

    Initial states are fitted alone before, as logged ones are noisy and their slopes are the cheaper ones.
    """
    states = fitted_states(simulator, readings, point, states, "cauchy")
    fit = _sloped(simulator, readings, states, point)
    for _ in range(most):
        moved, before = _descended(simulator, readings, fit), fit
        if moved is fit:
            break
        fresh = _sloped(simulator, readings, moved.states, moved.point)
        fit = min(fit, fresh, key=lambda each: each.unexplained)
        if not fit.gains_on(before):
            break
    return fit


def _sloped(
    simulator: Simulator,
    readings: Readings,
    states: Float[np.ndarray, "windows state"],
    point: Float[np.ndarray, " d"],
) -> Fit:
    """Residuals and their derivatives simulated at a point."""
    (slopes,) = slopes_at(simulator, readings, point[None], states[None])
    return Fit(point, states, slopes, explicable(slopes), slopes.whole)


def _descended(simulator: Simulator, readings: Readings, fit: Fit) -> Fit:
    """The fit after Gauss-Newton steps for as long as each gains much, all with the derivatives given.

    Derivatives take 1 + 2 d + n simulations of every window, a step takes one for each of `LENGTHS`.
    """
    for _ in range(STEPS):
        if not fit.slopes.whole.any():
            break
        before, fit = fit, _stepped(simulator, readings, fit)
        if not fit.gains_on(before):
            break
    return fit


def _stepped(simulator: Simulator, readings: Readings, fit: Fit) -> Fit:
    """The fit after a Gauss-Newton step of the length that gains most; the same point where none gains."""
    slopes = fit.slopes
    scaled = slopes.over(_noise(fit.left, fit.spare, slopes.whole, readings))
    left = eliminate(scaled, _weights(scaled))
    whole_step = damped_step(*triangular_factors(left.reduced, 1.0, "linear"), fit.point, DAMPING)
    of_states = readings.in_state_units(left.states_step(whole_step), fit.states.shape[1])
    points = fit.point + LENGTHS[:, None] * whole_step
    states = fit.states + LENGTHS[:, None, None] * of_states
    residuals = readings.residuals(simulator, points, states)[:, 0]
    tried = [
        replace(fit, point=point, states=state, slopes=slopes.at(residual))
        for point, state, residual in zip(points, states, residuals, strict=True)
    ]
    return min([fit, *tried], key=lambda each: each.unexplained)


@dataclass(frozen=True)
class Reduced:
    """Residuals of windows and their derivatives in units of the noise, without what initial states explain of them.

    Residuals far beyond the noise, as where a contact begins, count little.

    Attributes:
        eliminated: The residuals and derivatives, those by the parameters first.
        noise: Standard deviation of each value's noise.
        finite: The windows that count.
        count: Number of parameters.
    """

    eliminated: Eliminated
    noise: Float[np.ndarray, " values"]
    finite: Bool[np.ndarray, " all"]
    count: int

    def products(self, others: Float[np.ndarray, "all values others"] | None = None) -> Products:
        """Products of all columns, and of those of other terms, whose derivatives are given for all windows."""
        reduced = self.eliminated.reduced
        by_parameters, terms = reduced.jacobian[..., : self.count], reduced.jacobian[..., self.count :]
        if others is not None:
            further = self.eliminated.projected(others[self.finite] / self.noise[:, None])
            terms = np.concatenate([terms, further], axis=-1)
        return Products.of(reduced.residuals, by_parameters, terms)


def reduced_of(slopes: WindowSlopes, readings: Readings, count: int) -> Reduced | None:
    """What no initial state explains of residuals and derivatives; None if there is nothing to explain."""
    finite = slopes.finite
    if not finite.any() or negligible(slopes):
        return None
    kept = WindowSlopes(
        slopes.residuals[finite], slopes.by_parameters[finite], slopes.by_states[finite], slopes.whole[finite]
    )
    noise = _noise(*left_by_states(kept), kept.whole, readings)
    scaled = kept.over(noise)
    return Reduced(eliminate(scaled, _weights(scaled)), noise, finite, count)


def products_of(slopes: WindowSlopes, readings: Readings, count: int) -> Products | None:
    """Products of residuals and derivatives, those by so many parameters first; None if there is nothing to explain."""
    reduced = reduced_of(slopes, readings, count)
    return None if reduced is None else reduced.products()


def negligible(slopes: WindowSlopes) -> bool:
    """Whether there are residuals, and none of them is worth an explanation."""
    finite = slopes.finite
    return bool(finite.any()) and float(np.abs(slopes.residuals[finite]).max()) < NOTHING


def noise_of(fit: Fit, readings: Readings) -> Float[np.ndarray, " channels"]:
    """Standard deviation of each channel's noise in its typical changes, by what a fit leaves of its windows."""
    return _noise(fit.left, fit.spare, fit.slopes.whole, readings)[: len(readings.scale)]


def alike(fit: Fit, readings: Readings) -> float:
    """Correlation of what a fit leaves of a reading with what it leaves of the next, all signals in typical changes.

    It is about 0 for noise. What is smaller than `NEGLIGIBLE` counts as 0.
    """
    left = fit.left[fit.counted & fit.slopes.whole].reshape(-1, *readings.observed.shape[1:])
    square = max(float((left**2).sum()), NEGLIGIBLE**2 * max(1, left.size))
    return float((left[:, 1:] * left[:, :-1]).sum()) / square


def _noise(
    left: Float[np.ndarray, "windows values"],
    spare: Float[np.ndarray, "windows values"],
    whole: Bool[np.ndarray, " windows"],
    readings: Readings,
) -> Float[np.ndarray, " values"]:
    """Standard deviation of each value's noise, by what no initial state explains of the residuals."""
    shape = (-1, readings.steps + 1, len(readings.scale))
    return np.tile(channel_noise(left[whole].reshape(shape), spare[whole].reshape(shape)), shape[1])


def _weights(slopes: WindowSlopes) -> Float[np.ndarray, "windows values"]:
    """Weights of residuals in units of the noise, by Cauchy's loss."""
    return loss_slope((slopes.residuals / TUNING["cauchy"]) ** 2, "cauchy") * slopes.whole[:, None]
