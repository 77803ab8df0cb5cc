"""A simulator binds parameters; what it returns steps states. A backend is these two methods."""

from typing import Protocol

import numpy as np
from jaxtyping import Float

from madoc.parameters import ParameterSpace
from madoc.tasks.base import Task


class System(Protocol):
    """Dynamics at fixed parameters: `systems` of them, each with any number of rows."""

    @property
    def count(self) -> int:
        """How many systems, the first axis of every state."""
        ...

    def step(
        self, state: Float[np.ndarray, "systems rows state"], action: Float[np.ndarray, "systems rows action"]
    ) -> Float[np.ndarray, "systems rows state"]:
        """One control step. A row whose simulation failed comes back as NaN; the others are untouched."""
        ...

    def observe(self, state: Float[np.ndarray, "systems rows state"]) -> Float[np.ndarray, "systems rows observation"]:
        """What the sensors of these systems show there, with the bias each has; NaN where a state is NaN."""
        ...

    def unbiased(self, state: Float[np.ndarray, "systems rows state"]) -> Float[np.ndarray, "systems rows state"]:
        """States rebuilt from logged observations, corrected for the bias that each system's sensors have."""
        ...


class Simulator(Protocol):
    """A source domain whose parameters can be chosen."""

    @property
    def task(self) -> Task:
        """The robot and its functions of state."""
        ...

    @property
    def parameters(self) -> ParameterSpace:
        """What can be bound, in order."""
        ...

    @property
    def initial_state(self) -> Float[np.ndarray, " state"]:
        """Where an episode starts before noise."""
        ...

    @property
    def action_size(self) -> int:
        """Motors."""
        ...

    def bind(self, parameters: Float[np.ndarray, "systems parameters"]) -> System:
        """Dynamics at the given physical values, one system a row."""
        ...
