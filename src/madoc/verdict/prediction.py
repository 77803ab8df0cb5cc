"""Prediction error on the hold-out: logged actions are replayed from logged states, over one and several steps."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from madoc.data import Dataset
from madoc.identification.gauss_newton import DAMPING, descend
from madoc.identification.replay import window_residuals
from madoc.identification.states import logged_states, states_observed_as
from madoc.identification.windows import Windows, evenly, rows_that_fit, windows_at
from madoc.simulation.attitudes import differences, moved
from madoc.simulation.base import Simulator

MOST_WINDOWS = 400
"""Largest number of windows replayed: for normal residuals their mean error is within about 5 % of that of all."""
FEWEST_WINDOWS = 20
"""Smallest number of windows of a horizon; with fewer, the horizon is left out unless single steps are as few."""
WORST = 1.0
"""Smallest error, in typical changes of a stride, of a window whose simulation failed."""
NEARBY_STEPS = 8
"""Largest number of Gauss-Newton steps from an estimate: enough to reach the nearest local minimum."""
WHOLE_STEPS = 3
"""Number of Gauss-Newton steps on whole windows, at least 1; they begin at the minimum of single steps."""
_STILL = 1e-7
"""Largest component in [-1, 1] of a step; the search ends after a smaller one."""
_CANDIDATES = 2
"""Number of last points whose errors are compared over all horizons: the last step may have left the minimum."""


@dataclass(frozen=True)
class Replays:
    """Windows of the hold-out, as long as the longest of the `horizons`, after which errors are taken.

    `observation` and `rows` are those at the beginning of each window, `scale` is the typical change of each channel in
    a stride of the training rows.
    """

    simulator: Simulator
    windows: Windows
    observation: Float[np.ndarray, "windows observation"]
    rows: Int[np.ndarray, " windows"]
    episodes: Int[np.ndarray, " windows"]
    horizons: tuple[int, ...]
    scale: Float[np.ndarray, " observation"]

    def residuals(
        self, points: Float[np.ndarray, "systems d"], windows: Windows | None = None
    ) -> Float[np.ndarray, "systems windows steps observation"]:
        """Simulated minus logged observations after every step, in typical changes; NaN in windows that failed."""
        replayed = self.windows if windows is None else windows
        flat = window_residuals(self.simulator, replayed, points, self.scale)
        return flat.reshape(*flat.shape[:2], replayed.steps, len(self.scale))

    def magnitudes(
        self, residuals: Float[np.ndarray, "systems windows steps observation"]
    ) -> Float[np.ndarray, "windows systems horizons observation"]:
        """Absolute residuals at the horizons; see the function `magnitudes`."""
        return magnitudes(residuals[:, :, np.array(self.horizons) - 1])

    def noise_floor(
        self, held: Dataset, point: Float[np.ndarray, " d"], deviation: Float[np.ndarray, " observation"]
    ) -> Float[np.ndarray, "1 windows steps observation"]:
        """Residuals that sensor noise alone would cause, through the initial state and in what is compared with.

        `deviation` is the noise's standard deviation in typical changes of a stride, at parameters in [-1, 1].
        """
        shape = (len(self.windows), self.windows.steps, len(deviation))
        if not deviation.any():
            return np.zeros((1, *shape))
        rng = np.random.default_rng(0)
        observation = np.asarray(held.transitions.observation)
        noise = deviation * self.scale * rng.standard_normal(observation.shape)
        noisy = moved(self.simulator.task.attitudes, observation, noise)
        rebuilt = states_observed_as(held, self.simulator.task, self.rows, noisy)
        starts = np.where(np.isfinite(rebuilt), rebuilt, self.windows.states)
        following = self.residuals(point[None], replace(self.windows, states=starts))
        return following - self.residuals(point[None]) + deviation * rng.standard_normal(shape)

    def random_floor(
        self,
        point: Float[np.ndarray, " d"],
        noisy: Float[np.ndarray, "1 windows steps observation"],
        pushes: Float[np.ndarray, "windows steps observation"],
    ) -> Float[np.ndarray, "1 windows steps observation"]:
        """Residuals that sensor noise and random forces of each step would cause together.

        `noisy` are those of sensor noise alone; `pushes` are what random forces change in each control step, in typical
        changes of a stride: each step gets a random sign. Errors of a wrong model have the same sign from step to step
        and add up to more.
        """
        if not pushes.any():
            return noisy
        windows, task = self.windows, self.simulator.task
        signs = np.random.default_rng(1).choice([-1.0, 1.0], (len(windows), windows.steps, 1))
        assert task.state_from_observation is not None  # windows begin at states that are rebuilt by it
        system = self.simulator.bind(self.simulator.parameters.to_physical(np.clip(point, -1.0, 1.0))[None])
        steady = kicked = system.unbiased(np.ascontiguousarray(windows.states[None]))
        departures = []
        for step in range(windows.steps):
            action = np.ascontiguousarray(windows.actions[None, :, step])
            steady, kicked = system.step(steady, action), system.step(kicked, action)
            pushed = signs[:, step] * pushes[:, step] * self.scale
            seen = moved(task.attitudes, system.observe(kicked), pushed[None])
            physical = np.asarray(task.state_from_observation(seen), np.float64)
            rebuilt = np.concatenate([physical, kicked[..., physical.shape[-1] :]], axis=-1)
            known = np.isfinite(rebuilt).all(-1)
            if task.rebuildable is not None:  # a clipped reading says another state
                known &= np.asarray(task.rebuildable(seen))
            kicked = np.where(known[..., None], system.unbiased(rebuilt), kicked)
            departures.append(differences(task.attitudes, system.observe(kicked), system.observe(steady)))
        return noisy + np.stack(departures, axis=2) / self.scale

    def single_steps(self) -> Windows:
        """The beginning of each window, as long as the shortest horizon."""
        windows, steps = self.windows, self.horizons[0]
        return replace(windows, actions=windows.actions[:, :steps], following=windows.following[:, :steps])


def magnitudes(
    residuals: Float[np.ndarray, "systems windows horizons channels"],
) -> Float[np.ndarray, "windows systems horizons channels"]:
    """Absolute residuals, windows first.

    A window whose simulation failed counts as the worst that did not fail, and at least as `WORST`.
    """
    size = np.abs(residuals)
    worst = np.maximum(np.nanmax(np.where(np.isfinite(size), size, 0.0), axis=(0, 1)), WORST)
    return np.moveaxis(np.where(np.isfinite(size), size, worst), 0, 1)


def replays_of(
    held: Dataset,
    simulator: Simulator,
    scale: Float[np.ndarray, " observation"],
    lengths: tuple[int, ...],
    most: int = MOST_WINDOWS,
) -> Replays:
    """At most so many windows, evenly over the hold-out, of the `lengths` in control steps that it is long enough for.

    Raises:
        MadocError: None of its states can be rebuilt.
    """
    states, rows = logged_states(held, simulator.task)
    lengths = lengths if len(rows_that_fit(held, rows, lengths[0])) else (1,)
    starts = {length: rows_that_fit(held, rows, length) for length in lengths}
    enough = min(FEWEST_WINDOWS, len(starts[lengths[0]]))
    horizons = tuple(horizon for horizon in lengths if len(starts[horizon]) >= enough)
    chosen = evenly(starts[horizons[-1]], most)
    return Replays(
        simulator,
        windows_at(held, states[chosen], rows[chosen], horizons[-1]),
        np.asarray(held.transitions.observation)[rows[chosen]],
        rows[chosen],
        held.episode_of(rows[chosen]),
        horizons,
        scale,
    )


def nearby_best(replays: Replays, point: Float[np.ndarray, " d"]) -> Float[np.ndarray, "points d"]:
    """The last points of Gauss-Newton steps from an estimate on single steps of the hold-out.

    These points have been fitted to the hold-out itself, so none is an estimate: they show what parameters could reach.
    """
    _, visited = descend(
        replays.simulator,
        replays.single_steps(),
        point,
        replays.scale,
        steps=NEARBY_STEPS,
        loss="cauchy",
        damping=DAMPING,
        shortest=_STILL,
    )
    return visited[-_CANDIDATES:]
