"""Windows of a log simulated under many parameter vectors, and their residuals."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from madoc.data.dataset import Dataset, spread_of
from madoc.identification.linearisation import (
    DIFFERENCE,
    WindowSlopes,
    difference_points,
    one_sided_points,
    slopes_of_windows,
)
from madoc.identification.states import LoggedStates
from madoc.identification.windows import Windows, readings_at
from madoc.simulation.attitudes import differences
from madoc.simulation.base import Simulator, System


def window_residuals(
    simulator: Simulator,
    windows: Windows,
    points: Float[np.ndarray, "systems d"],
    scale: Float[np.ndarray, " observation"],
) -> Float[np.ndarray, "systems windows values"]:
    """Simulated minus logged observations after every action, over `scale`, from the windows' logged states.

    Residuals of attitudes are rotations, as in `simulation.attitudes`.

    NaN in windows whose simulation failed. Spends systems · windows · steps control steps.
    """
    system = simulator.bind(simulator.parameters.to_physical(np.clip(points, -1.0, 1.0)))
    states = system.unbiased(
        np.ascontiguousarray(np.broadcast_to(windows.states, (len(points), *windows.states.shape)))
    )
    seen = _observations(system, states, windows.actions)
    residuals = differences(simulator.task.attitudes, seen, windows.following) / scale
    return residuals.reshape(len(points), len(windows.states), math.prod(residuals.shape[2:]))


@dataclass(frozen=True)
class Readings:
    """Windows whose initial states are unknown, so that the observation at the first row is a measurement as well.

    Attributes:
        actions: The actions taken.
        observed: The observations, from that at the first row on.
        scale: Typical change of each channel in a step, of which residuals are multiples.
        spread: Standard deviation of each value of (qpos, qvel) over the log, of which steps of initial states are
            multiples; 0 of places in the plane on which nothing depends. Pending actions are known.
    """

    actions: Float[np.ndarray, "windows steps action"]
    observed: Float[np.ndarray, "windows readings channels"]
    scale: Float[np.ndarray, " channels"]
    spread: Float[np.ndarray, " physical"]

    @classmethod
    def at(
        cls,
        dataset: Dataset,
        logged: LoggedStates,
        rows: Int[np.ndarray, " windows"],
        steps: int,
        scale: Float[np.ndarray, " observation"],
    ) -> "Readings":
        """The windows of `steps` rows that begin at the given rows."""
        return cls(
            actions=np.asarray(dataset.transitions.action)[rows[:, None] + np.arange(steps)],
            observed=readings_at(dataset, rows, steps)[..., : logged.measured],
            scale=scale[: logged.measured],
            spread=np.where(logged.in_plane, 0.0, spread_of(logged.states[:, : logged.physical_size])),
        )

    def __len__(self) -> int:
        return len(self.actions)

    def of(self, kept: Int[np.ndarray, " some"]) -> "Readings":
        """These windows alone."""
        return replace(self, actions=self.actions[kept], observed=self.observed[kept])

    @property
    def steps(self) -> int:
        """Length of each window in control steps."""
        return self.actions.shape[1]

    @property
    def activity(self) -> Float[np.ndarray, " windows"]:
        """Mean change between observations of each window, of which at most 3 typical changes a channel count."""
        change = np.abs(np.diff(self.observed, axis=1)) / self.scale
        return np.minimum(change, 3.0).mean((1, 2))

    def in_state_units(self, steps: Float[np.ndarray, "*rows physical"], size: int) -> Float[np.ndarray, "*rows state"]:
        """Multiples of `spread` as differences of states of `size` values."""
        differences = np.zeros((*steps.shape[:-1], size))
        differences[..., : len(self.spread)] = steps * self.spread
        return differences

    def trajectories(
        self, simulator: Simulator, point: Float[np.ndarray, " d"], states: Float[np.ndarray, "windows state"]
    ) -> tuple[Float[np.ndarray, "windows steps state"], Float[np.ndarray, "windows steps actuator dof"]]:
        """The simulated state before each action, and what each actuator exerts there on every degree of freedom.

        Spends windows · steps control steps.
        """
        system = simulator.bind(simulator.parameters.to_physical(np.clip(point, -1.0, 1.0))[None])
        after = system.roll_out(states[None], self.actions[None])[0]
        visited = np.concatenate([states[:, None], after[:, :-1]], axis=1)
        rows = len(self) * self.steps
        flat_states, flat_actions = (each.reshape(1, rows, each.shape[-1]) for each in (visited, self.actions))
        exerted = system.actuator_forces(flat_states, flat_actions)
        return visited, exerted.reshape(*visited.shape[:2], *exerted.shape[2:])

    def residuals(
        self,
        simulator: Simulator,
        points: Float[np.ndarray, "systems d"],
        states: Float[np.ndarray, "systems rows state"],
        force: Float[np.ndarray, "systems rows steps dof"] | None = None,
    ) -> Float[np.ndarray, "systems times windows values"]:
        """Simulated minus measured observations, where each system's states are those of the windows, repeated.

        NaN in windows whose simulation failed. `force` acts on each degree of freedom in each control step, in N or
        N·m. Spends systems · rows · steps control steps.
        """
        times = states.shape[1] // len(self)
        system = simulator.bind(simulator.parameters.to_physical(np.clip(points, -1.0, 1.0)))
        start = np.ascontiguousarray(states)
        following = _observations(system, start, np.tile(self.actions, (times, 1, 1)), force)
        simulated = np.concatenate([system.observe(start)[:, :, None], following], axis=2)[..., : len(self.scale)]
        simulated = simulated.reshape(len(points), times, *self.observed.shape)
        residuals = differences(simulator.task.attitudes, simulated, self.observed) / self.scale
        return residuals.reshape(len(points), times, len(self), -1)


def slopes_at(
    simulator: Simulator,
    readings: Readings,
    points: Float[np.ndarray, "points d"],
    states: Float[np.ndarray, "points windows state"],
    *,
    parameters: bool = True,
    initial_states: bool = True,
    central: bool = True,
    width: Float[np.ndarray, " physical"] | None = None,
) -> list[WindowSlopes]:
    """Residuals and their derivatives around every point's parameters and initial states, in two batches.

    Differences by parameters are central, which contacts need, or one-sided, which serves where motion is smooth; those
    by the many state values are one-sided. Without `parameters` there are only the latter, and d is 0; without
    `initial_states` only the former, and n is 0. Differences are `DIFFERENCE` wide, those by initial states `width`
    where that is larger, in standard deviations of each value over the log. It takes points · windows ·
    (1 + 2 d + n) · steps control steps, or (1 + d + n) of one-sided differences.
    """
    count, windows, size = states.shape
    neighbours = difference_points if central else one_sided_points
    around = np.stack([neighbours(point) if parameters else point[None] for point in points])
    each = around.shape[1]
    by_points = readings.residuals(simulator, around.reshape(-1, points.shape[1]), np.repeat(states, each, axis=0))
    by_points = by_points.reshape(count, each, windows, -1)
    by_shifts = np.zeros((count, 0, *by_points.shape[2:]))
    widths = np.maximum(DIFFERENCE, np.zeros(len(readings.spread)) if width is None else width)
    if initial_states:
        shifted = states[:, None] + readings.in_state_units(np.diag(widths), size)[:, None]
        by_shifts = readings.residuals(simulator, points, shifted.reshape(count, -1, size))
    return [slopes_of_windows(*parts, widths) for parts in zip(around, by_points, by_shifts, strict=True)]


def _observations(
    system: System,
    state: Float[np.ndarray, "systems rows state"],
    actions: Float[np.ndarray, "rows steps action"],
    force: Float[np.ndarray, "systems rows steps dof"] | None = None,
) -> Float[np.ndarray, "systems rows steps observation"]:
    """The observation after each of the actions."""
    after = system.roll_out(state, np.broadcast_to(actions, (system.count, *actions.shape)), force)
    seen = system.observe(after.reshape(len(after), -1, after.shape[-1]))
    return seen.reshape(*after.shape[:3], seen.shape[-1])
