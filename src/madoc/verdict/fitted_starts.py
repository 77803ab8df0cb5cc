"""Prediction error on rows held out where velocities are hidden: starts are fitted to one stretch, the next predicted.

The hidden part of a state shows in the observations that follow it. The first stretch of each window is used up by
fitting its start, at every estimate alike; errors are those of the stretch behind it, which no fit has seen.
"""

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from madoc.data import Dataset
from madoc.identification.gauss_newton import eliminate
from madoc.identification.noise import residual_noise
from madoc.identification.replay import Readings, slopes_at
from madoc.identification.states import states_of
from madoc.identification.windows import evenly, rows_that_fit
from madoc.simulation.base import Simulator
from madoc.verdict.prediction import FEWEST_WINDOWS, magnitudes

FITTED = 10
"""Control steps at the beginning of a window whose observations determine its start."""
AHEAD = (1, 5, 10)
"""Control steps behind the fitted stretch after which errors are taken."""
MOST = 150
"""Windows, at most."""
FIT_STEPS = 10
"""Damped Gauss-Newton steps: more than a start needs that is near already, as finite differences of positions are."""
_SHARES = np.array([1.0, 0.3, 0.1, 0.0])
"""Shares of a step, from 0 to 1, of which every window takes the one that fits it best."""
_DAMPING = 1e-8
"""Relative damping of a start's step."""


@dataclass(frozen=True)
class FittedReplays:
    """Windows of the rows held out, whose initial states are unknown.

    Attributes:
        simulator: What simulates them.
        readings: The actions taken and the observations made in them.
        near: Initial guesses of the states that they begin in.
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
        """The initial states under which each system comes nearest to the observations of the first stretch."""
        whole = self.readings if readings is None else readings
        first = replace(whole, actions=whole.actions[:, :FITTED], observed=whole.observed[:, : FITTED + 1])
        states = np.repeat(self.near[None], len(unit), axis=0)
        damping, size = np.full(len(first), _DAMPING), states.shape[2]
        for _ in range(FIT_STEPS):
            around = slopes_at(self.simulator, first, unit, states, parameters=False)
            fits = [eliminate(slopes, np.ones_like(slopes.residuals), damping) for slopes in around]
            step = first.in_state_units(np.stack([fit.states_step(np.zeros(0)) for fit in fits]), size)
            tried = states[:, None] + _SHARES[:, None, None] * step[:, None]
            cost = _costs(first.residuals(self.simulator, unit, tried.reshape(len(unit), -1, size)))
            best = cost.argmin(1)[:, None, :, None]
            states = np.take_along_axis(tried, best, axis=1)[:, 0]
        return states

    def residuals(
        self,
        unit: Float[np.ndarray, "systems d"],
        states: Float[np.ndarray, "systems windows state"],
        readings: Readings | None = None,
    ) -> Float[np.ndarray, "systems windows readings channels"]:
        """Simulated minus measured observations of whole windows, in typical changes of a step; NaN if one failed."""
        whole = self.readings if readings is None else readings
        flat = whole.residuals(self.simulator, unit, states)[:, 0]
        return flat.reshape(*flat.shape[:2], *whole.observed.shape[1:])

    def magnitudes(
        self, residuals: Float[np.ndarray, "systems windows readings channels"]
    ) -> Float[np.ndarray, "windows systems horizons channels"]:
        """|residual| at the horizons, windows first; a failed window counts as the worst that did not fail."""
        return magnitudes(residuals[:, :, FITTED + np.array(self.horizons)])

    def deviation(self, residuals: Float[np.ndarray, "windows readings channels"]) -> Float[np.ndarray, " channels"]:
        """Noise of each channel, in typical changes of a step, from the residuals of the fitted stretch."""
        return residual_noise(residuals[:, : FITTED + 1], len(self.readings.spread))

    def with_noise_alone(
        self,
        unit: Float[np.ndarray, " d"],
        residuals: Float[np.ndarray, "windows readings channels"],
        deviation: Float[np.ndarray, " channels"],
        key: PRNGKeyArray,
    ) -> Float[np.ndarray, "1 windows readings channels"]:
        """Residuals of the same windows if the system at `unit` had been the real one, with noise of `deviation`."""
        noise = np.asarray(jax.random.normal(key, residuals.shape), np.float64) * deviation
        simulated = np.where(np.isfinite(residuals), residuals, 0.0) + noise
        drawn = replace(self.readings, observed=self.readings.observed + simulated * self.readings.scale)
        return self.residuals(unit[None], self.starts(unit[None], drawn), drawn)

    @property
    def fit_cost(self) -> int:
        """Control steps that fitting the starts of one system takes."""
        columns = 1 + len(self.readings.spread) + len(_SHARES)
        return FIT_STEPS * columns * len(self.readings) * FITTED


def fitted_replays_of(
    held: Dataset, simulator: Simulator, scale: Float[np.ndarray, " channels"]
) -> FittedReplays | None:
    """Windows spread evenly over the rows held out; None where too few are long enough."""
    logged = states_of(held, simulator)
    near, rows = logged.guesses()
    steps = FITTED + AHEAD[-1]
    possible = rows_that_fit(held, rows, steps)
    if len(possible) < FEWEST_WINDOWS:
        return None
    chosen = evenly(possible, MOST)
    readings = Readings.at(held, logged, rows[chosen], steps, scale)
    return FittedReplays(simulator, readings, near[chosen], held.episode_of(rows[chosen]))


def _costs(residuals: Float[np.ndarray, "systems times windows values"]) -> Float[np.ndarray, "systems times windows"]:
    """Sums of squares; infinite in windows that failed."""
    with np.errstate(over="ignore", invalid="ignore"):
        cost = (residuals**2).sum(-1)
    return np.where(np.isfinite(cost), cost, np.inf)
