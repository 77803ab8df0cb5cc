"""Prediction error on rows held out: logged actions replayed from logged states, over one and several steps."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from madoc.calibration.least_squares.damped_step import damped_step, triangular_factors
from madoc.data import Dataset, logged_states
from madoc.identification.linearisation import difference_points, linearise
from madoc.identification.losses import scale_of
from madoc.identification.replay import window_residuals
from madoc.identification.windows import Windows, evenly, rows_that_fit, windows_at
from madoc.simulation.base import Simulator

HORIZONS = (1, 5, 20)
"""Control steps. One shows what a method fits; what is wrong by little in each step adds up over many."""
MOST_WINDOWS = 400
"""Mean errors of so many differ by 5 % from those of all where residuals are normal."""
FEWEST_WINDOWS = 20
"""A longer horizon is left out where fewer windows are as long, unless there are fewer of one step too."""
WORST = 1.0
"""Steps' changes that a failed window counts for at least."""
NEARBY_STEPS = 8
"""Gauss-Newton steps from an estimate, at most: enough to come to the bottom of the hollow it lies in."""
_STILL = 1e-7
"""A step in [-1, 1] so small is the last."""
_DAMPING = 1e-6
_KEPT = 2
"""Points looked at over all horizons: the last, and the one before, should the last have left the hollow."""


@dataclass(frozen=True)
class Replays:
    """Windows of the rows held out, as long as the longest horizon.

    Attributes:
        simulator: What replays them.
        windows: The windows.
        observation: What was seen where each begins.
        rows: The row of the hold-out that each begins at.
        episodes: The episode of each.
        horizons: Steps after which errors are taken.
        scale: Typical change of each signal in a step, of the rows kept.
    """

    simulator: Simulator
    windows: Windows
    observation: Float[np.ndarray, "windows observation"]
    rows: Int[np.ndarray, " windows"]
    episodes: Int[np.ndarray, " windows"]
    horizons: tuple[int, ...]
    scale: Float[np.ndarray, " observation"]

    def residuals(
        self, unit: Float[np.ndarray, "systems d"], windows: Windows | None = None
    ) -> Float[np.ndarray, "systems windows steps observation"]:
        """Simulated less logged observations after every step, in steps' changes; NaN once a window failed."""
        replayed = self.windows if windows is None else windows
        flat = window_residuals(self.simulator, replayed, unit, self.scale)
        return flat.reshape(*flat.shape[:2], replayed.steps, len(self.scale))

    def magnitudes(
        self, residuals: Float[np.ndarray, "systems windows steps observation"]
    ) -> Float[np.ndarray, "windows systems horizons observation"]:
        """|residual| at the horizons, windows first; a failed window counts as the worst that did not fail."""
        size = np.abs(residuals[:, :, np.array(self.horizons) - 1])
        worst = np.maximum(np.nanmax(np.where(np.isfinite(size), size, 0.0), axis=(0, 1)), WORST)
        return np.moveaxis(np.where(np.isfinite(size), size, worst), 0, 1)

    def single_steps(self) -> Windows:
        """Only the first step of each window."""
        windows = self.windows
        return replace(windows, actions=windows.actions[:, :1], following=windows.following[:, :1])


def replays_of(held: Dataset, simulator: Simulator, scale: Float[np.ndarray, " observation"]) -> Replays:
    """Windows spread evenly over the rows held out.

    Raises:
        MadocError: No state of them can be rebuilt.
    """
    states, rows = logged_states(held, simulator.task)
    starts = {horizon: rows_that_fit(held, rows, horizon) for horizon in HORIZONS}
    enough = min(FEWEST_WINDOWS, len(starts[1]))
    horizons = tuple(horizon for horizon in HORIZONS if len(starts[horizon]) >= enough)
    chosen = evenly(starts[horizons[-1]], MOST_WINDOWS)
    return Replays(
        simulator,
        windows_at(held, states[chosen], rows[chosen], horizons[-1]),
        np.asarray(held.transitions.observation)[rows[chosen]],
        rows[chosen],
        held.episode_of(rows[chosen]),
        horizons,
        scale,
    )


def nearby_best(replays: Replays, unit: Float[np.ndarray, " d"]) -> tuple[Float[np.ndarray, "points d"], int]:
    """Where Gauss-Newton steps on single steps of the windows lead from an estimate, and their cost.

    They look at the rows held out, so none is an estimate: they tell what the parameters could explain at best.
    """
    windows = replays.single_steps()
    found, spent = [], 0
    for _ in range(NEARBY_STEPS):
        points = difference_points(unit)
        residuals = window_residuals(replays.simulator, windows, points, replays.scale)
        spent += len(points) * len(windows)
        around = linearise(points, residuals)
        if not len(around.residuals):
            break
        scale = scale_of(around.residuals, "cauchy")
        step = damped_step(*triangular_factors(around, scale, "cauchy"), unit, _DAMPING)
        unit = unit + step
        found.append(unit)
        if np.abs(step).max() < _STILL:
            break
    return np.array(found[-_KEPT:]).reshape(-1, len(unit)), spent
