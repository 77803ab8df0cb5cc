"""The CPU backend: MuJoCo's own threaded rollout, all cores, float64."""

import copy
import os
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Float

from madoc.errors import MadocError
from madoc.parameters import FIELDS, ParameterSpace
from madoc.simulation.write import find_element, write_parameters
from madoc.tasks.base import Task

_CLOCK = 1.0
"""s. Every row starts its step at this time; MuJoCo resets an exploding simulation, and its clock tells."""

_ROWS_FOR_ALL_THREADS = 8
"""Below this many rows waking a second thread costs more than it saves."""


class CpuSimulator:
    """A task's MuJoCo model with calibratable parameters.

    Args:
        task: The robot.
        threads: How many cores step it; all that this process may use by default.

    Raises:
        MadocError: A parameter names an element that the model does not have.
    """

    def __init__(self, task: Task, *, threads: int | None = None) -> None:
        self.task = task
        self.threads = threads or len(os.sched_getaffinity(0))
        self._model = task.compile()
        if self._model.na or self._model.nmocap:
            raise MadocError(f"{task.name}: models with actuator activations or mocap bodies are not supported")
        for parameter in task.parameters.parameters:
            find_element(self._model, parameter)
        self._data = [mujoco.MjData(self._model) for _ in range(self.threads)]
        self._pool = mujoco.rollout.Rollout(nthread=self.threads if self.threads > 1 else 0)
        self._alone = mujoco.rollout.Rollout(nthread=0)

    @property
    def parameters(self) -> ParameterSpace:
        """What can be bound, in order."""
        return self.task.parameters

    @property
    def initial_state(self) -> Float[np.ndarray, " state"]:
        """The model's own (qpos0, 0)."""
        return np.concatenate([self._model.qpos0, np.zeros(self._model.nv)])

    @property
    def action_size(self) -> int:
        """Motors."""
        return int(self._model.nu)

    @property
    def control_step(self) -> float:
        """Seconds per control step."""
        return float(self._model.opt.timestep) * self.task.frame_skip

    def bind(self, parameters: Float[np.ndarray, "systems parameters"]) -> "CpuSystem":
        """Copy the model once per row of physical values and write them.

        Raises:
            MadocError: Values are not finite, not one per parameter, or below a physical bound.
        """
        values = np.asarray(parameters, dtype=np.float64)
        if values.ndim != 2 or values.shape[1] != len(self.parameters):
            raise MadocError(f"expected parameters of shape (systems, {len(self.parameters)}), got {values.shape}")
        if not np.isfinite(values).all():
            raise MadocError("expected finite parameters, got NaN or infinity")
        for parameter, column in zip(self.parameters.parameters, values.T, strict=True):
            minimum = FIELDS[parameter.field].minimum
            if (column < minimum).any():
                raise MadocError(
                    f"expected {parameter.name} of at least {minimum} {parameter.unit}, "
                    f"got {column.min()} in system {column.argmin()}"
                )
        models = []
        for row in values:
            model = copy.copy(self._model)
            write_parameters(model, self._data[0], self.parameters.parameters, row)
            models.append(model)
        return CpuSystem(self, models)

    def model(self, values: Float[np.ndarray, " parameters"]) -> mujoco.MjModel:
        """A MuJoCo model of its own at the given physical values."""
        return self.bind(np.asarray(values)[None]).models[0]


class CpuSystem:
    """Systems at fixed parameters; states are (qpos, qvel).

    The solver's warm start is always 0, so a step is a function of state, action and parameters alone,
    whatever the number of threads.
    """

    def __init__(self, simulator: CpuSimulator, models: list[mujoco.MjModel]) -> None:
        self.models = models
        self._simulator = simulator
        self._rows = 0

    @property
    def count(self) -> int:
        """How many systems."""
        return len(self.models)

    def step(
        self, state: Float[np.ndarray, "systems rows state"], action: Float[np.ndarray, "systems rows action"]
    ) -> Float[np.ndarray, "systems rows state"]:
        """One control step of `frame_skip` physics steps; a row that explodes comes back as NaN.

        Raises:
            MadocError: States or actions do not have the shape of these systems.
        """
        self._check_shapes(state.shape, action.shape)
        self._allocate(state.shape[1])
        simulator = self._simulator
        self._start[:, 1:] = state.reshape(self._start.shape[0], -1)
        self._control[:] = action.reshape(self._control.shape[0], 1, -1)
        bad = ~np.isfinite(self._start).all(1)
        if bad.any():
            self._start[bad, 1:] = simulator.initial_state
        many = len(self._start) >= _ROWS_FOR_ALL_THREADS
        pool = simulator._pool if many else simulator._alone
        with _quiet():
            pool.rollout(
                self._repeated,
                simulator._data if many else simulator._data[:1],
                self._start,
                self._control,
                skip_checks=True,
                nstep=simulator.task.frame_skip,
                state=self._trajectory,
                sensordata=self._sensors,
            )
        end = self._trajectory[:, -1]
        failed = bad | (abs(end[:, 0] - self._end) > 1e-9) | ~(abs(end) <= mujoco.mjMAXVAL).all(1)
        next_state = end[:, 1:].copy()
        next_state[failed] = np.nan
        return next_state.reshape(state.shape)

    def _check_shapes(self, state: tuple[int, ...], action: tuple[int, ...]) -> None:
        model = self.models[0]
        rows = state[1] if len(state) == 3 else 0
        if state != (self.count, rows, model.nq + model.nv) or action != (self.count, rows, model.nu):
            raise MadocError(
                f"expected states of shape ({self.count}, rows, {model.nq + model.nv}) and actions of shape "
                f"({self.count}, rows, {model.nu}) for {self._simulator.task.name}, got {state} and {action}"
            )

    def _allocate(self, rows: int) -> None:
        if rows == self._rows:
            return
        model, steps = self.models[0], self._simulator.task.frame_skip
        total, size = self.count * rows, 1 + model.nq + model.nv
        self._rows = rows
        self._end = _CLOCK + steps * model.opt.timestep
        self._repeated = [model for model in self.models for _ in range(rows)]
        self._start = np.full((total, size), _CLOCK)
        self._control = np.zeros((total, steps, model.nu))
        self._trajectory = np.zeros((total, steps, size))
        self._sensors = np.zeros((total, steps, model.nsensordata))


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep MuJoCo's word on an exploding row (stderr, MUJOCO_LOG.TXT in the working directory) to itself.

    Such rows come back as NaN and are counted.
    """
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_ignore)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _ignore(_: str) -> None:
    pass
