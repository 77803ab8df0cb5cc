"""Whether the model is integrated finely enough for the log of a machine."""

import numpy as np
from jaxtyping import Float

from madoc.data import Dataset, typical_change
from madoc.data.findings import Finding
from madoc.identification.coarseness import COARSE, FINER, coarseness
from madoc.identification.states import LoggedStates
from madoc.simulation.base import Simulator


def timestep_findings(
    dataset: Dataset, simulator: Simulator, logged: LoggedStates, point: Float[np.ndarray, " d"]
) -> tuple[list[Finding], int]:
    """A warning where a finer integration changes predictions by much, and the control steps simulated.

    Args:
        dataset: The log.
        simulator: The model.
        logged: The log's states.
        point: The parameters in [-1, 1] at which both are simulated.
    """
    scale = typical_change(dataset, simulator.task.attitudes)
    change, spent = coarseness(dataset, logged, simulator, point, scale)
    if change <= COARSE:
        return [], spent
    timestep = simulator.control_step / simulator.task.frame_skip
    what = (
        f"its timestep of {timestep:.12g} s is too long: with {timestep / FINER:.12g} s predictions of half of the "
        f"signals change by {change:.2g} typical changes or more, which parameters would make up for"
    )
    remedy = f"give timestep: {timestep / FINER:.12g} in the spec, unless the log is of a simulation with this timestep"
    return [Finding("warning", what, "the model", remedy)], spent
