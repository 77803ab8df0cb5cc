"""What a simulator backend provides: a simulator binds parameters, and the systems it returns step states."""

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Float, Int

from madoc.parameters import ParameterSpace
from madoc.tasks.base import Task


class _Simulated(threading.local):
    control_steps = 0


SIMULATED = _Simulated()
"""The control steps, each of one row, that systems have simulated in this thread. What a part of the work took is a
difference; systems add to it, and `counted_as`."""


@contextmanager
def counted_as(times: int) -> Iterator[None]:
    """Count each control step as so many: with a timestep that is as many times as short it takes as much more time."""
    began = SIMULATED.control_steps
    yield
    SIMULATED.control_steps += (times - 1) * (SIMULATED.control_steps - began)


@runtime_checkable
class System(Protocol):
    """Dynamics at fixed parameters: `count` systems, each with any number of rows."""

    count: int

    def step(
        self,
        state: Float[np.ndarray, "systems rows state"],
        action: Float[np.ndarray, "systems rows action"],
        force: Float[np.ndarray, "systems rows dof"] | None = None,
    ) -> Float[np.ndarray, "systems rows state"]:
        """One control step. A row whose simulation failed comes back as NaN; the others are untouched.

        `force` acts on each degree of freedom from outside all the while, in N or N·m.
        """

    def roll_out(
        self,
        state: Float[np.ndarray, "systems rows state"],
        actions: Float[np.ndarray, "systems rows steps action"],
        force: Float[np.ndarray, "systems rows steps dof"] | None = None,
    ) -> Float[np.ndarray, "systems rows steps state"]:
        """The state after each of several actions; NaN from where a simulation failed.

        It is quicker than a step at a time. Where there are constraints, the two agree within the tolerance of the
        solver, which starts each step of a rollout from the solution of the step before. `force` is what acts on each
        degree of freedom from outside during each of the steps, in N or N·m.
        """

    def observe(self, state: Float[np.ndarray, "systems rows state"]) -> Float[np.ndarray, "systems rows observation"]:
        """Observations of these states with the bias of each system's sensors; NaN where a state is NaN."""

    def actuator_forces(
        self, state: Float[np.ndarray, "systems rows state"], action: Float[np.ndarray, "systems rows action"]
    ) -> Float[np.ndarray, "systems rows actuator dof"]:
        """What each actuator exerts on every degree of freedom at the start of a step, in N or N·m.

        Late actions count as late.
        """

    def unbiased(self, state: Float[np.ndarray, "systems rows state"]) -> Float[np.ndarray, "systems rows state"]:
        """States rebuilt from logged observations, corrected for the bias of each system's sensors."""

    def replaced(self, systems: Int[np.ndarray, " some"], parameters: Float[np.ndarray, "some parameters"]) -> "System":
        """These systems, with those of the given indices bound to other physical values."""


@runtime_checkable
class Simulator(Protocol):
    """The source domain: a robot whose parameters can be chosen. A backend is this class and its `System`.

    Attributes:
        task: The robot and its functions of state.
        parameters: The parameters that can be bound, in order.
        action_size: Number of values per action.
        control_step: Time between two actions in s.
    """

    task: Task
    parameters: ParameterSpace
    action_size: int
    control_step: float

    @property
    def initial_state(self) -> Float[np.ndarray, " state"]:
        """State at the start of an episode, before the noise of a reset."""

    def bind(self, parameters: Float[np.ndarray, "*systems parameters"] | Mapping[str, float]) -> System:
        """Dynamics at physical values: those of one system, by name or as a vector, or of one system in each row."""

    def contacts(
        self, state: Float[np.ndarray, "rows state"], values: Float[np.ndarray, " parameters"] | None = None
    ) -> Int[np.ndarray, " rows"]:
        """Number of pairs of geoms in contact in each state, at physical values, which are mid-range unless given.

        No parameter changes the shape of a body; `jnt_ref`, `body_distance` and numbers of the model may move it.
        """

    def model(self, values: Float[np.ndarray, " parameters"]) -> mujoco.MjModel:
        """The MuJoCo model at the given physical values, to export; owned by the caller."""
