"""Prediction error on rows held out: logged actions replayed from logged states, over one and several steps."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from madoc.data import Dataset
from madoc.identification.gauss_newton import damped_step, triangular_factors
from madoc.identification.linearisation import difference_points, linearise
from madoc.identification.losses import scale_of
from madoc.identification.replay import window_residuals
from madoc.identification.states import logged_states, states_observed_as
from madoc.identification.windows import HORIZONS, Windows, evenly, rows_that_fit, windows_at
from madoc.simulation.base import Simulator

MOST_WINDOWS = 400
"""Windows replayed at most: for normal residuals their mean error differs by about 5 % from that of all windows."""
FEWEST_WINDOWS = 20
"""Windows of a horizon, without which it is left out; fewer are enough if there are as few of a single step."""
WORST = 1.0
"""Least error, in typical changes of a step, that a window counts for whose simulation failed."""
NEARBY_STEPS = 8
"""Most Gauss-Newton steps from an estimate: enough to come to the local minimum it is near."""
_STILL = 1e-7
"""Largest component of a step in [-1, 1] at which the search ends."""
_DAMPING = 1e-6
"""Relative damping of a step; 0 is none."""
_KEPT = 2
"""Points compared over all horizons: the last, and the one before in case the last step left the minimum."""


@dataclass(frozen=True)
class Replays:
    """Windows of the rows held out, as long as the longest horizon.

    Attributes:
        simulator: What simulates them.
        windows: The windows.
        observation: The observation at the first row of each.
        rows: The first row of each in the hold-out.
        episodes: The episode of each.
        horizons: Control steps after which errors are taken.
        scale: Typical change of each channel in a step, of the rows that methods see.
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
        """Simulated minus logged observations after every step, in typical changes; NaN in windows that failed."""
        replayed = self.windows if windows is None else windows
        flat = window_residuals(self.simulator, replayed, unit, self.scale)
        return flat.reshape(*flat.shape[:2], replayed.steps, len(self.scale))

    def magnitudes(
        self, residuals: Float[np.ndarray, "systems windows steps observation"]
    ) -> Float[np.ndarray, "windows systems horizons observation"]:
        """|residual| at the horizons, windows first; a failed window counts as the worst that did not fail."""
        return magnitudes(residuals[:, :, np.array(self.horizons) - 1])

    def noise_floor(
        self, held: Dataset, unit: Float[np.ndarray, " d"], deviation: Float[np.ndarray, " observation"]
    ) -> Float[np.ndarray, "1 windows steps observation"]:
        """Prediction errors that noise alone would cause at the given parameters, of the start and of what follows.

        Args:
            held: The hold-out that the windows are from.
            unit: Parameters in [-1, 1].
            deviation: Standard deviation of the noise, in typical changes of a step.
        """
        shape = (len(self.windows), self.windows.steps, len(deviation))
        if not deviation.any():
            return np.zeros((1, *shape))
        rng = np.random.default_rng(0)
        observation = np.asarray(held.transitions.observation)
        noisy = observation + deviation * self.scale * rng.standard_normal(observation.shape)
        rebuilt = states_observed_as(held, self.simulator.task, self.rows, noisy)
        starts = np.where(np.isfinite(rebuilt), rebuilt, self.windows.states)
        moved = self.residuals(unit[None], replace(self.windows, states=starts))
        return moved - self.residuals(unit[None]) + deviation * rng.standard_normal(shape)

    def single_steps(self) -> Windows:
        """The first step of each window alone."""
        windows = self.windows
        return replace(windows, actions=windows.actions[:, :1], following=windows.following[:, :1])


def magnitudes(
    residuals: Float[np.ndarray, "systems windows horizons channels"],
) -> Float[np.ndarray, "windows systems horizons channels"]:
    """|residual|, windows first; a failed window counts as the worst that did not fail, and at least as `WORST`."""
    size = np.abs(residuals)
    worst = np.maximum(np.nanmax(np.where(np.isfinite(size), size, 0.0), axis=(0, 1)), WORST)
    return np.moveaxis(np.where(np.isfinite(size), size, worst), 0, 1)


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

    The steps look at the rows held out, so none of the points is an estimate: they show what parameters could explain.
    """
    windows = replays.single_steps()
    reached, spent = [], 0
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
        reached.append(unit)
        if np.abs(step).max() < _STILL:
            break
    return np.array(reached[-_KEPT:]).reshape(-1, len(unit)), spent
