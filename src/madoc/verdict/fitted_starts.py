"""Prediction error on rows held out where velocities are hidden: a start is fitted to one stretch, the next predicted.

What a state's hidden part was is told by the readings that follow it. Each window's first stretch is used up by that,
at every estimate alike; errors are those of the stretch behind it, which no fit has seen.
"""

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.readings import Readings
from madoc.identification.linearisation import DIFFERENCE
from madoc.identification.windows import evenly, rows_that_fit
from madoc.simulation.base import Simulator
from madoc.verdict.prediction import FEWEST_WINDOWS, WORST

FITTED = 10
"""Control steps whose readings tell the start."""
AHEAD = (1, 5, 10)
"""Control steps behind them after which errors are taken."""
MOST = 150
FIT_STEPS = 10
"""Damped Gauss-Newton steps: more than a start needs that is already near, as differences of positions are."""
_SHARES = np.array([1.0, 0.3, 0.1, 0.0])
"""Of a step, from which every window takes what fits it best."""
_DAMPING = 1e-8
_SHORTEST = 1e-3
"""Least length of a slope, relative to the window's longest: what no reading shows stays where it is."""


@dataclass(frozen=True)
class FittedReplays:
    """Windows of the rows held out, without their states.

    Attributes:
        simulator: What replays them.
        readings: What was done and read in them.
        near: States near those that they begin in.
        episodes: The episode of each.
        horizons: Control steps behind the fitted stretch after which errors are taken.
    """

    simulator: Simulator
    readings: Readings
    near: Float[np.ndarray, "windows state"]
    episodes: Int[np.ndarray, " windows"]
    horizons: tuple[int, ...] = AHEAD

    def starts(
        self, unit: Float[np.ndarray, "systems d"], readings: Readings | None = None
    ) -> Float[np.ndarray, "systems windows state"]:
        """The starts under which each system comes nearest to the readings of the first stretch."""
        whole = self.readings if readings is None else readings
        first = replace(whole, actions=whole.actions[:, :FITTED], observed=whole.observed[:, : FITTED + 1])
        states = np.repeat(self.near[None], len(unit), axis=0)
        for _ in range(FIT_STEPS):
            step = first.moved(self._steps(first, unit, states), states.shape[2])
            tried = states[:, None] + _SHARES[:, None, None] * step[:, None]
            cost = _costs(first.residuals(self.simulator, unit, tried.reshape(len(unit), -1, states.shape[2])))
            best = cost.argmin(1)[:, None, :, None]
            states = np.take_along_axis(tried, best, axis=1)[:, 0]
        return states

    def residuals(
        self,
        unit: Float[np.ndarray, "systems d"],
        states: Float[np.ndarray, "systems windows state"],
        readings: Readings | None = None,
    ) -> Float[np.ndarray, "systems windows readings channels"]:
        """Simulated less logged readings of the whole windows, in steps' changes; NaN once one failed."""
        whole = self.readings if readings is None else readings
        flat = whole.residuals(self.simulator, unit, states)[:, 0]
        return flat.reshape(*flat.shape[:2], *whole.observed.shape[1:])

    def magnitudes(
        self, residuals: Float[np.ndarray, "systems windows readings channels"]
    ) -> Float[np.ndarray, "windows systems horizons channels"]:
        """|residual| at the horizons, windows first; a failed window counts as the worst that did not fail."""
        size = np.abs(residuals[:, :, FITTED + np.array(self.horizons)])
        worst = np.maximum(np.nanmax(np.where(np.isfinite(size), size, 0.0), axis=(0, 1)), WORST)
        return np.moveaxis(np.where(np.isfinite(size), size, worst), 0, 1)

    def deviation(self, residuals: Float[np.ndarray, "windows readings channels"]) -> Float[np.ndarray, " channels"]:
        """Noise of each channel, in steps' changes, from what a fit leaves of the first stretch."""
        first = residuals[:, : FITTED + 1]
        first = first[np.isfinite(first).all((1, 2))]
        values = first.shape[1] * first.shape[2]
        freedom = max(1, values - len(self.readings.spread)) / values
        return np.sqrt((first**2).mean((0, 1)) / freedom) if len(first) else np.zeros(residuals.shape[-1])

    def with_noise_alone(
        self,
        unit: Float[np.ndarray, " d"],
        residuals: Float[np.ndarray, "windows readings channels"],
        deviation: Float[np.ndarray, " channels"],
        key: PRNGKeyArray,
    ) -> Float[np.ndarray, "1 windows readings channels"]:
        """Residuals of the same windows, were the system the true one and its sensors as noisy as that."""
        noise = np.asarray(jax.random.normal(key, residuals.shape), np.float64) * deviation
        shown = (
            self.readings.observed + (np.where(np.isfinite(residuals), residuals, 0.0) + noise) * self.readings.scale
        )
        drawn = replace(self.readings, observed=shown)
        return self.residuals(unit[None], self.starts(unit[None], drawn), drawn)

    @property
    def fit_cost(self) -> int:
        """Control steps that fitting the starts of one system takes."""
        columns = 1 + 2 * len(self.readings.spread) + len(_SHARES)
        return FIT_STEPS * columns * len(self.readings) * FITTED

    def _steps(
        self, first: Readings, unit: Float[np.ndarray, "systems d"], states: Float[np.ndarray, "systems windows state"]
    ) -> Float[np.ndarray, "systems windows physical"]:
        """Gauss-Newton steps of all starts, in units of their spread; 0 where a window failed."""
        count, size = len(first.spread), states.shape[2]
        shift = first.moved(DIFFERENCE * np.eye(count), size)
        shifted = states[:, None] + np.concatenate([np.zeros((1, size)), shift, -shift])[:, None]
        found = first.residuals(self.simulator, unit, shifted.reshape(len(unit), -1, size))
        slopes = np.moveaxis(found[:, 1 : count + 1] - found[:, count + 1 :], 1, -1) / (2.0 * DIFFERENCE)
        whole = np.isfinite(found).all((1, 3))
        residuals = np.where(whole[..., None], found[:, 0], 0.0)
        slopes = np.where(whole[..., None, None], slopes, 0.0)
        lengths = np.linalg.norm(slopes, axis=2)
        lengths = np.maximum(lengths, np.maximum(_SHORTEST * lengths.max(-1, keepdims=True), 1e-100))
        scaled = slopes / lengths[..., None, :]
        curvature = np.swapaxes(scaled, -1, -2) @ scaled + _DAMPING * np.eye(count)
        pull = np.swapaxes(scaled, -1, -2) @ residuals[..., None]
        return -np.linalg.solve(curvature, pull)[..., 0] / lengths


def fitted_replays_of(held: CalibrationProblem, scale: Float[np.ndarray, " channels"]) -> FittedReplays | None:
    """Windows spread evenly over the rows held out; None where too few are long enough."""
    near, rows = held.approximate_states
    steps = FITTED + AHEAD[-1]
    possible = rows_that_fit(held.dataset, rows, steps)
    if len(possible) < FEWEST_WINDOWS:
        return None
    chosen = evenly(possible, MOST)
    readings = replace(Readings.at(held, rows[chosen], steps), scale=scale[: held.measured])
    episodes = held.dataset.episode_of(rows[chosen])
    return FittedReplays(held.simulator, readings, near[chosen], episodes)


def _costs(residuals: Float[np.ndarray, "systems times windows values"]) -> Float[np.ndarray, "systems times windows"]:
    """Sums of squares; no number is worse than any."""
    with np.errstate(over="ignore", invalid="ignore"):
        cost = (residuals**2).sum(-1)
    return np.where(np.isfinite(cost), cost, np.inf)
