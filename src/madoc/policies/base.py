"""What a policy learner is given, and what it must offer."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.data import Dataset
from madoc.errors import MadocError
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.simulation.base import Simulator
from madoc.types import Metrics

State = Any


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


class PolicyLearner(Protocol):
    """A method. It holds hyperparameters only; what it carries is in its state."""

    @property
    def name(self) -> str:
        """As `madoc methods` lists it."""
        ...

    @property
    def shown(self) -> tuple[str, ...]:
        """Metrics worth a place beside the progress bar."""
        ...

    def init(self, problem: PolicyProblem, key: PRNGKeyArray) -> State:
        """A cheap start: networks, buffers, the random key."""
        ...

    def step(self, problem: PolicyProblem, state: State) -> tuple[State, Metrics]:
        """One epoch."""
        ...

    def policy(self, state: State) -> TanhGaussianPolicy:
        """The policy learnt so far."""
        ...

    def control_steps(self, state: State) -> int:
        """Simulated control steps spent."""
        ...

    def stage(self, state: State) -> str:
        """A word for what it is doing."""
        ...

    def progress(self, state: State, budget: int) -> float:
        """Share of the work done, in [0, 1]."""
        ...

    def converged(self, state: State) -> str | None:
        """A sentence once it has stopped by itself."""
        ...
