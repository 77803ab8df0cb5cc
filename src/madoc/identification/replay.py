"""Windows of a log simulated under many parameter vectors, and how far they are from what was logged."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from madoc.data.dataset import Dataset
from madoc.identification.linearisation import DIFFERENCE, WindowSlopes, difference_points, slopes_of_windows
from madoc.identification.states import LoggedStates
from madoc.identification.windows import Windows, readings_at
from madoc.simulation.base import Simulator, System


def window_residuals(
    simulator: Simulator,
    windows: Windows,
    unit: Float[np.ndarray, "systems d"],
    scale: Float[np.ndarray, " observation"],
) -> Float[np.ndarray, "systems windows values"]:
    """Simulated minus logged observations after every action, over `scale`, from the windows' logged states.

    NaN in windows whose simulation failed. Spends systems · windows · steps control steps.
    """
    system = simulator.bind(simulator.parameters.to_physical(np.clip(unit, -1.0, 1.0)))
    states = system.unbiased(np.ascontiguousarray(np.broadcast_to(windows.states, (len(unit), *windows.states.shape))))
    simulated = _observations(system, states, windows.actions)
    columns = [(then - windows.following[:, step]) / scale for step, then in enumerate(simulated)]
    return np.concatenate(columns, axis=-1)


def simulated_readings(
    simulator: Simulator,
    unit: Float[np.ndarray, "systems d"],
    states: Float[np.ndarray, "systems rows state"],
    actions: Float[np.ndarray, "rows steps action"],
) -> Float[np.ndarray, "systems rows readings observation"]:
    """The observation at every system's own states, then after each of the actions; NaN once a simulation failed.

    Spends systems · rows · steps control steps.
    """
    system = simulator.bind(simulator.parameters.to_physical(np.clip(unit, -1.0, 1.0)))
    start = np.ascontiguousarray(states)
    return np.stack([system.observe(start), *_observations(system, start, actions)], axis=2)


@dataclass(frozen=True)
class Readings:
    """Windows whose initial states are unknown, so that the observation at the first row is a measurement as well.

    Attributes:
        actions: The actions taken.
        observed: What was measured; the first value of each window is at its first row.
        scale: Unit of the residuals of each channel: its typical change in a step.
        spread: Unit of the steps of initial states: the standard deviation of each value of (qpos, qvel) over the log.
            Pending actions are known, and no unknowns.
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
            spread=spread_of(logged.states[:, : logged.physical_size]),
        )

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def steps(self) -> int:
        """Length of each window in control steps."""
        return self.actions.shape[1]

    @property
    def activity(self) -> Float[np.ndarray, " windows"]:
        """How much each window moves: the mean change between observations, at most 3 typical changes a channel."""
        change = np.abs(np.diff(self.observed, axis=1)) / self.scale
        return np.minimum(change, 3.0).mean((1, 2))

    def in_state_units(self, steps: Float[np.ndarray, "*rows physical"], size: int) -> Float[np.ndarray, "*rows state"]:
        """Steps in units of `spread` as differences of states of `size` values."""
        differences = np.zeros((*steps.shape[:-1], size))
        differences[..., : len(self.spread)] = steps * self.spread
        return differences

    def residuals(
        self,
        simulator: Simulator,
        unit: Float[np.ndarray, "systems d"],
        states: Float[np.ndarray, "systems rows state"],
    ) -> Float[np.ndarray, "systems times windows values"]:
        """Simulated minus measured observations, where each system's states are those of the windows, repeated.

        NaN in windows whose simulation failed. Spends systems · rows · steps control steps.
        """
        times = states.shape[1] // len(self)
        simulated = simulated_readings(simulator, unit, states, np.tile(self.actions, (times, 1, 1)))
        simulated = simulated[..., : len(self.scale)]
        residuals = (simulated.reshape(len(unit), times, *self.observed.shape) - self.observed) / self.scale
        return residuals.reshape(len(unit), times, len(self), -1)


def spread_of(states: Float[np.ndarray, "rows physical"]) -> Float[np.ndarray, " physical"]:
    """Standard deviation of each value over the rows; 1 for a value that never changes."""
    spread = states.std(0)
    return np.where(spread > 1e-8, spread, 1.0)


def slopes_at(
    simulator: Simulator,
    readings: Readings,
    unit: Float[np.ndarray, "points d"],
    states: Float[np.ndarray, "points windows state"],
    *,
    parameters: bool = True,
) -> list[WindowSlopes]:
    """Residuals and their derivatives around every point's parameters and initial states, in two batches.

    Central differences by parameters, as confidence intervals are made of them; one-sided ones by states, of which
    there are many. Spends points · windows · (1 + 2 d + n) · steps control steps, the first batch being
    points · windows · (1 + 2 d) · steps.

    Args:
        simulator: What simulates.
        readings: The windows.
        unit: Parameters in [-1, 1].
        states: Initial states of the windows.
        parameters: Whether to differentiate by parameters; else d = 0 in what is returned.
    """
    count, windows, size = states.shape
    points = np.stack([difference_points(point) if parameters else point[None] for point in unit])
    each = points.shape[1]
    by_points = readings.residuals(simulator, points.reshape(-1, unit.shape[1]), np.repeat(states, each, axis=0))
    shift = readings.in_state_units(DIFFERENCE * np.eye(len(readings.spread)), size)
    shifted = states[:, None] + shift[:, None]
    by_shifts = readings.residuals(simulator, unit, shifted.reshape(count, -1, size))
    by_points = by_points.reshape(count, each, windows, -1)
    return [slopes_of_windows(*parts) for parts in zip(points, by_points, by_shifts, strict=True)]


def _observations(
    system: System, state: Float[np.ndarray, "systems rows state"], actions: Float[np.ndarray, "rows steps action"]
) -> Iterator[Float[np.ndarray, "systems rows observation"]]:
    """The observation after each of the actions."""
    for action in np.moveaxis(actions, 1, 0):
        state = system.step(state, np.ascontiguousarray(np.broadcast_to(action, (system.count, *action.shape))))
        yield system.observe(state)
