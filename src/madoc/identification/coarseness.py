"""How much the model's integration step changes its predictions: where by much, no parameters make up for that."""

import numpy as np
from jaxtyping import Float

from madoc import simulation
from madoc.data import Dataset, stride
from madoc.identification.replay import window_residuals
from madoc.identification.states import LoggedStates, probing_windows
from madoc.simulation.base import Simulator

WINDOWS = 64
"""Largest number of windows."""
FINER = 4
"""Number of integration steps that take the place of one."""
COARSE = 0.25
"""Change of predictions in typical changes of a signal, above which the integration step is too long for its robot."""
_DIVERGED = 1.0
"""Typical changes that a window counts for where only the model's own integration step diverges."""


def coarseness(
    dataset: Dataset,
    logged: LoggedStates,
    simulator: Simulator,
    point: Float[np.ndarray, " d"],
    scale: Float[np.ndarray, " observation"],
) -> tuple[float, int]:
    """By how much predictions one stride ahead change with integration steps of a quarter of the length.

    Smooth motion hardly changes. Where contacts begin or end it may, and then parameters fitted to a machine, whose
    motion has no integration step, are not the machine's.

    Args:
        dataset: The log.
        logged: What it says of states.
        simulator: The model.
        point: The parameters in [-1, 1].
        scale: Typical change of each signal in a stride, of which the result is a multiple.

    Returns:
        The median over signals of the root mean square over windows of the log, as a signal that hardly moves may
        change by much of its little. A window whose finer simulation fails is left out; 0 where none is left. Then the
        control steps simulated.
    """
    windows = probing_windows(logged, dataset, simulator, steps=stride(dataset), count=WINDOWS)
    finer = simulation.make(simulator.task.with_time_step(1.0 / FINER, substeps=FINER))
    coarse, fine = (
        window_residuals(each, windows, point[None], scale)[0].reshape(len(windows), windows.steps, -1)[:, -1]
        for each in (simulator, finer)
    )
    counted = np.isfinite(fine).all(-1)
    change = np.abs(fine - coarse)[counted]
    change = np.where(np.isfinite(change), change, _DIVERGED)
    spent = 2 * len(windows) * windows.steps
    return (float(np.median(np.sqrt((change**2).mean(0)))) if len(change) else 0.0), spent
