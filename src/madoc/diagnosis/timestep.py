"""Whether the model is integrated finely enough for the log of a machine."""

import numpy as np
from jaxtyping import Float

from madoc.data import Dataset, typical_change
from madoc.data.findings import Finding
from madoc.diagnosis.channels import signal_names
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
    changes, spent = coarseness(dataset, logged, simulator, point, typical_change(dataset))
    worst = int(np.argmax(changes))
    if changes[worst] <= COARSE:
        return [], spent
    timestep = simulator.control_step / simulator.task.frame_skip
    what = (
        f"its timestep of {timestep:g} s is too long: with {timestep / FINER:g} s predictions of "
        f"{signal_names(simulator.task)[worst]} change by {changes[worst]:.2g} typical changes, which parameters would "
        "make up for"
    )
    remedy = f"give timestep: {timestep / FINER:g} in the spec, unless the log is of a simulation with this timestep"
    return [Finding("warning", what, "the model", remedy)], spent
