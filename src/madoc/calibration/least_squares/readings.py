"""Windows of a log with all their readings, and what simulating them from estimated initial states says."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.elimination import WindowSlopes
from madoc.identification.linearisation import DIFFERENCE, difference_points
from madoc.identification.replay import simulated_readings
from madoc.identification.windows import readings_at
from madoc.simulation.base import Simulator


@dataclass(frozen=True)
class Readings:
    """What was done and read in windows.

    Attributes:
        actions: Done.
        observed: Measured, at the first row too.
        scale: Each channel's typical change in a step: the unit of residuals.
        spread: How much each value of (qpos, qvel) differs between rows: the unit of initial states' steps. Pending
            actions are known, and no unknowns.
    """

    actions: Float[np.ndarray, "windows steps action"]
    observed: Float[np.ndarray, "windows readings channels"]
    scale: Float[np.ndarray, " channels"]
    spread: Float[np.ndarray, " physical"]

    @classmethod
    def at(cls, problem: CalibrationProblem, rows: Int[np.ndarray, " windows"], steps: int) -> "Readings":
        """The windows of so many steps that begin at the given rows."""
        spread = problem.approximate_states[0].std(0)[: problem.physical_size]
        return cls(
            actions=np.asarray(problem.dataset.transitions.action)[rows[:, None] + np.arange(steps)],
            observed=readings_at(problem.dataset, rows, steps)[..., : problem.measured],
            scale=problem.scalings["standardised"].next_scale[: problem.measured],
            spread=np.where(spread > 1e-8, spread, 1.0),
        )

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def steps(self) -> int:
        """Control steps of each."""
        return self.actions.shape[1]

    @property
    def activity(self) -> Float[np.ndarray, " windows"]:
        """How much happens in each: the mean change from reading to reading, of a channel up to 3 typical ones."""
        change = np.abs(np.diff(self.observed, axis=1)) / self.scale
        return np.minimum(change, 3.0).mean((1, 2))

    def moved(self, steps: Float[np.ndarray, "*rows physical"], size: int) -> Float[np.ndarray, "*rows state"]:
        """Steps in units of `spread` as differences of states of so many values."""
        differences = np.zeros((*steps.shape[:-1], size))
        differences[..., : len(self.spread)] = steps * self.spread
        return differences

    def residuals(
        self,
        simulator: Simulator,
        unit: Float[np.ndarray, "systems d"],
        states: Float[np.ndarray, "systems rows state"],
    ) -> Float[np.ndarray, "systems times windows values"]:
        """Simulated less logged readings, where every system holds the windows one or several times over.

        NaN once a window failed. Spends systems · rows · steps control steps.
        """
        times = states.shape[1] // len(self)
        shown = simulated_readings(simulator, unit, states, np.tile(self.actions, (times, 1, 1)))
        shown = shown[..., : len(self.scale)]
        found = (shown.reshape(len(unit), times, *self.observed.shape) - self.observed) / self.scale
        return found.reshape(len(unit), times, len(self), -1)


def slopes_at(
    simulator: Simulator,
    readings: Readings,
    unit: Float[np.ndarray, "searches d"],
    states: Float[np.ndarray, "searches windows state"],
) -> list[WindowSlopes]:
    """Residuals and differences around every search's parameters and states, all in one batch each.

    Central ones by parameters, as intervals are made of them; one-sided ones by states, of which there are many.
    Parameters are systems, states are rows: searches · windows · (1 + 2 d + n) · steps control steps.
    """
    searches, windows, size = states.shape
    points = np.stack([difference_points(point) for point in unit])
    each, count = points.shape[1:]
    by_points = readings.residuals(simulator, points.reshape(-1, count), np.repeat(states, each, axis=0))
    shift = readings.moved(DIFFERENCE * np.eye(len(readings.spread)), size)
    shifted = states[:, None] + shift[:, None]
    by_shifts = readings.residuals(simulator, unit, shifted.reshape(searches, -1, size))
    by_points = by_points.reshape(searches, each, windows, -1)
    return [_differences(*parts, count) for parts in zip(points, by_points, by_shifts, strict=True)]


def _differences(
    points: Float[np.ndarray, "points d"],
    by_points: Float[np.ndarray, "points windows values"],
    by_shifts: Float[np.ndarray, "shifts windows values"],
    count: int,
) -> WindowSlopes:
    """Differences; by parameters one-sided where their box ends."""
    whole = np.isfinite(by_points).all((0, 2)) & np.isfinite(by_shifts).all((0, 2))
    with np.errstate(invalid="ignore"):
        width = np.diagonal(points[1 : count + 1] - points[count + 1 :])
        by_parameters = (by_points[1 : count + 1] - by_points[count + 1 :]) / width[:, None, None]
        by_states = (by_shifts - by_points[0]) / DIFFERENCE
    parts = (np.where(whole[:, None], part, 0.0) for part in (by_points[0], by_parameters, by_states))
    residuals, by_parameters, by_states = parts
    return WindowSlopes(residuals, np.moveaxis(by_parameters, 0, -1), np.moveaxis(by_states, 0, -1), whole)
