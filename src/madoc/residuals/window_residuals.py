"""How far many systems, each stepped from the same logged states under the same logged actions, are from the log."""

import numpy as np
from jaxtyping import Float

from madoc.data.windows import Windows
from madoc.simulation.base import Simulator


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
    shape = (len(unit), *windows.states.shape)
    state = system.unbiased(np.ascontiguousarray(np.broadcast_to(windows.states, shape)))
    columns = []
    for step in range(windows.steps):
        action = windows.actions[:, step]
        state = system.step(state, np.ascontiguousarray(np.broadcast_to(action, (len(unit), *action.shape))))
        columns.append((system.observe(state) - windows.following[:, step]) / scale)
    return np.concatenate(columns, axis=-1)
