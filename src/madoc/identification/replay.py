"""How far many systems, each stepped from the same logged states under the same logged actions, are from the log."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from madoc.identification.windows import Windows
from madoc.simulation.base import Simulator, System


def simulated_readings(
    simulator: Simulator,
    unit: Float[np.ndarray, "systems d"],
    states: Float[np.ndarray, "systems rows state"],
    actions: Float[np.ndarray, "rows steps action"],
) -> Float[np.ndarray, "systems rows readings observation"]:
    """What every system shows from its states on, under the same actions: at once, then after each of the steps.

    NaN once a row failed. Spends systems · rows · steps control steps.
    """
    system = simulator.bind(simulator.parameters.to_physical(np.clip(unit, -1.0, 1.0)))
    start = np.ascontiguousarray(states)
    return np.stack([system.observe(start), *_shown(system, start, actions)], axis=2)


def window_residuals(
    simulator: Simulator,
    windows: Windows,
    unit: Float[np.ndarray, "systems d"],
    scale: Float[np.ndarray, " observation"],
) -> Float[np.ndarray, "systems windows values"]:
    """Simulated less logged observations after every action of the windows, over `scale`; NaN once a window failed.

    Spends systems · windows · steps control steps.
    """
    system = simulator.bind(simulator.parameters.to_physical(np.clip(unit, -1.0, 1.0)))
    states = system.unbiased(np.ascontiguousarray(np.broadcast_to(windows.states, (len(unit), *windows.states.shape))))
    shown = _shown(system, states, windows.actions)
    columns = [(shown_then - windows.following[:, step]) / scale for step, shown_then in enumerate(shown)]
    return np.concatenate(columns, axis=-1)


def _shown(
    system: System, state: Float[np.ndarray, "systems rows state"], actions: Float[np.ndarray, "rows steps action"]
) -> Iterator[Float[np.ndarray, "systems rows observation"]]:
    """What is observed after each of the actions."""
    for action in np.moveaxis(actions, 1, 0):
        state = system.step(state, np.ascontiguousarray(np.broadcast_to(action, (system.count, *action.shape))))
        yield system.observe(state)
