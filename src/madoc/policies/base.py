"""What a policy learner is given."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from madoc.data import Dataset
from madoc.errors import MadocError
from madoc.simulation.base import Simulator


@dataclass(frozen=True)
class PolicyProblem:
    """Learn a policy in these systems.

    Attributes:
        simulator: The source domain.
        parameters: Physical values, one system a row; a vector (d,) is one system.
        dataset: Logged transitions, for learners that use them.
    """

    simulator: Simulator
    parameters: Float[np.ndarray, "systems parameters"]
    dataset: Dataset | None = None

    def __post_init__(self) -> None:
        values = np.atleast_2d(np.asarray(self.parameters, dtype=np.float64))
        if values.shape[1] != len(self.simulator.parameters):
            raise MadocError(
                f"expected {len(self.simulator.parameters)} parameter values for {self.simulator.task.name}, "
                f"got {values.shape[1]}"
            )
        object.__setattr__(self, "parameters", values)
