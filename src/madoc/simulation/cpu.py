"""The CPU backend: MuJoCo's own threaded rollout, all cores, float64."""

import copy
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Float, Int

from madoc.errors import MadocError, nearest_hint
from madoc.parameters import FIELDS, Parameter, ParameterSpace
from madoc.simulation.delay import blend, delay_weights, in_effect
from madoc.simulation.write import find_elements, write_parameters
from madoc.tasks.base import Task

_CLOCK = 1.0
"""Time in s at which every row starts its step; MuJoCo resets a simulation that diverges, which its clock shows."""

_ROWS_FOR_ALL_THREADS = 8
"""Number of rows from which all threads step them; with fewer, waking a second thread costs more than it saves."""


class CpuSimulator:
    """A task's MuJoCo model with calibratable parameters.

    Args:
        task: The robot.
        threads: Number of cores that step it; by default all that this process may use.

    Raises:
        MadocError: A parameter names an element that the model does not have.
    """

    def __init__(self, task: Task, *, threads: int | None = None) -> None:
        self.task = task
        self.threads = threads or len(os.sched_getaffinity(0))
        self._model = task.model
        if self._model.na or self._model.nmocap:
            raise MadocError(f"{task.name}: models with actuator activations or mocap bodies are not supported")
        for parameter in task.parameters.parameters:
            _check_elements(self._model, task, parameter)
        self._actuators = [self._model.actuator(channel.actuator).id for channel in task.actions]
        low, high, scale = (
            np.array([getattr(channel, name) for channel in task.actions]) for name in ("low", "high", "scale")
        )
        self._centre, self._half = scale * (low + high) / 2.0, scale * (high - low) / 2.0
        self._data = [mujoco.MjData(self._model) for _ in range(self.threads)]
        self._pool = mujoco.rollout.Rollout(nthread=self.threads if self.threads > 1 else 0)
        self._alone = mujoco.rollout.Rollout(nthread=0)

    @property
    def parameters(self) -> ParameterSpace:
        """The parameters that can be bound, in order."""
        return self.task.parameters

    @property
    def initial_state(self) -> Float[np.ndarray, " state"]:
        """The model's (qpos0, 0), followed by the pending actions at rest."""
        rest = [channel.rest for channel in self.task.actions] or self.action_size * [0.0]
        return np.concatenate([self._model.qpos0, np.zeros(self._model.nv), np.tile(rest, self.task.pending)])

    @property
    def action_size(self) -> int:
        """Values per action."""
        return self.task.action_size

    @property
    def control_step(self) -> float:
        """Seconds per control step."""
        return float(self._model.opt.timestep) * self.task.frame_skip

    def bind(self, parameters: Float[np.ndarray, "*systems parameters"] | Mapping[str, float]) -> "CpuSystem":
        """Copy the model once for each system, and write the system's physical values into it.

        Args:
            parameters: Values of one system, by name or as a vector, or of several, one in each row.

        Raises:
            MadocError: Values are not finite, not one per parameter, or below a physical bound.
        """
        values = np.atleast_2d(self.parameters.vector(parameters))
        if values.ndim != 2:
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
        return CpuSystem(self, models, delay=self._delays(values), bias=self._biases(values))

    def _delays(self, values: Float[np.ndarray, "systems parameters"]) -> Float[np.ndarray, " systems"]:
        """Time in s from an action to its effect."""
        delay, longest = self._summed(values, "action_delay", ())[:, 0], self.task.pending * self.control_step
        if (delay > longest + 1e-9).any():
            raise MadocError(
                f"expected an action_delay of at most {longest:g} s, got {delay.max():g}: a state of {self.task.name} "
                f"carries {self.task.pending} past actions; widen the range of its action_delay"
            )
        return np.minimum(delay, longest)

    def _biases(self, values: Float[np.ndarray, "systems parameters"]) -> Float[np.ndarray, "systems _"] | None:
        """Bias of each signal; None where no bias is calibrated."""
        if all(parameter.field != "signal_bias" for parameter in self.parameters.parameters):
            return None
        return self._summed(values, "signal_bias", self.task.signals)

    def _summed(
        self, values: Float[np.ndarray, "systems parameters"], field: str, elements: tuple[str, ...]
    ) -> Float[np.ndarray, "systems elements"]:
        """The values of a field by element, 0 where none is calibrated; one column where the field has no elements."""
        sums = np.zeros((len(values), max(1, len(elements))))
        for parameter, column in zip(self.parameters.parameters, values.T, strict=True):
            if parameter.field == field:
                for index in [elements.index(element) for element in parameter.elements] or [0]:
                    sums[:, index] += column
        return sums

    def _controls(self, action: Float[np.ndarray, "*rows action"]) -> Float[np.ndarray, "*rows control"]:
        """Controls of the model's actuators for an action; 0 for actuators that no action channel drives."""
        if not self.task.actions:
            return action
        control = np.zeros((*action.shape[:-1], self._model.nu))
        control[..., self._actuators] = self._centre + self._half * action
        return control

    def model(self, values: Float[np.ndarray, " parameters"]) -> mujoco.MjModel:
        """A MuJoCo model at the given physical values, owned by the caller."""
        return self.bind(np.asarray(values)[None]).models[0]


class CpuSystem:
    """Systems at fixed parameters; states are (qpos, qvel, pending actions).

    The solver's warm start is always 0, so a step depends on state, action and parameters alone, whatever the number
    of threads.
    """

    def __init__(
        self,
        simulator: CpuSimulator,
        models: list[mujoco.MjModel],
        *,
        delay: Float[np.ndarray, " systems"] | None = None,
        bias: Float[np.ndarray, "systems observation"] | None = None,
    ) -> None:
        self.models = models
        self._simulator = simulator
        self._physical = models[0].nq + models[0].nv
        self._delay, self._bias = np.zeros(len(models)) if delay is None else delay, bias
        self._rows = 0

    @property
    def count(self) -> int:
        """Number of systems."""
        return len(self.models)

    def replaced(
        self, systems: Int[np.ndarray, " some"], parameters: Float[np.ndarray, "some parameters"]
    ) -> "CpuSystem":
        """These systems, with those of the given indices bound to other parameters."""
        new, models, delay = self._simulator.bind(parameters), list(self.models), self._delay.copy()
        for index, model in zip(systems, new.models, strict=True):
            models[index] = model
        delay[systems] = new._delay
        bias = None if self._bias is None else self._bias.copy()
        if bias is not None:
            bias[systems] = new._bias
        return CpuSystem(self._simulator, models, delay=delay, bias=bias)

    def step(
        self, state: Float[np.ndarray, "systems rows state"], action: Float[np.ndarray, "systems rows action"]
    ) -> Float[np.ndarray, "systems rows state"]:
        """One control step of `frame_skip` physics steps; a row whose simulation diverges comes back as NaN.

        Raises:
            MadocError: States or actions do not have the shape of these systems.
        """
        self._check_shapes(state.shape, action.shape)
        self._allocate(state.shape[1])
        if not self._simulator.task.pending:
            self._control[:] = self._simulator._controls(action).reshape(self._control.shape[0], 1, -1)
            return self._roll_out(state, self._control, self._trajectory, self._sensors)
        history = np.concatenate([action[..., None, :], self._pending(state)], axis=-2)
        applied = blend(self._weights, history)
        self._control[:] = self._simulator._controls(applied).reshape(self._control.shape)
        moved = self._roll_out(state[..., : self._physical], self._control, self._trajectory, self._sensors)
        failed = np.isnan(moved[..., :1])
        kept = history[..., :-1, :].reshape(*moved.shape[:2], -1)
        return np.concatenate([moved, np.where(failed, np.nan, kept)], axis=-1)

    def observe(self, state: Float[np.ndarray, "systems rows state"]) -> Float[np.ndarray, "systems rows observation"]:
        """Observations with each system's bias; NaN where a state is NaN.

        A sensor of the model is read in a forward pass under the control that is in effect, where the state carries it
        (`Task.pending`), else under no control.
        """
        task = self._simulator.task
        seen = task.observe(state) if task.sense is None else task.sense(state, self._sensordata(state))
        return seen if self._bias is None else seen + self._bias[:, None]

    def unbiased(self, state: Float[np.ndarray, "systems rows state"]) -> Float[np.ndarray, "systems rows state"]:
        """States rebuilt from logged observations, corrected for the bias of each system's sensors."""
        rebuild = self._simulator.task.state_from_observation or self._simulator.task.posture
        if self._bias is None or rebuild is None:
            return state
        shift = np.zeros((self.count, 1, state.shape[-1]))
        shift[:, 0, : self._physical] = np.nan_to_num(rebuild(self._bias) - rebuild(np.zeros_like(self._bias)))
        return state - shift

    def _sensordata(self, state: Float[np.ndarray, "systems rows state"]) -> np.ndarray:
        self._allocate(state.shape[1])
        model, total = self.models[0], len(self._start)
        control = np.zeros((total, 1, model.nu))
        if self._simulator.task.pending:
            newest = in_effect(self._delay, self._simulator.control_step)
            last = self._pending(state)[np.arange(self.count), :, newest]
            control[:] = self._simulator._controls(last).reshape(total, 1, -1)
        trajectory, sensors = np.zeros((total, 1, self._start.shape[1])), np.zeros((total, 1, model.nsensordata))
        moved = self._roll_out(state[..., : self._physical], control, trajectory, sensors)
        sensordata = sensors[:, 0].reshape(*state.shape[:2], -1).copy()
        sensordata[np.isnan(moved).any(-1)] = np.nan
        return sensordata

    def _pending(self, state: Float[np.ndarray, "systems rows state"]) -> np.ndarray:
        """Past actions, newest first: (systems, rows, pending, action)."""
        past = state[..., self._physical :]
        return past.reshape(*state.shape[:2], self._simulator.task.pending, -1)

    def _roll_out(
        self,
        state: Float[np.ndarray, "systems rows physical"],
        control: Float[np.ndarray, "total steps control"],
        trajectory: Float[np.ndarray, "total steps 1+physical"],
        sensors: Float[np.ndarray, "total steps sensor"],
    ) -> Float[np.ndarray, "systems rows physical"]:
        """States after the physics steps under given controls; `trajectory` and `sensors` are filled in place."""
        simulator, steps = self._simulator, control.shape[1]
        self._start[:, 1:] = state.reshape(self._start.shape[0], -1)
        bad = ~np.isfinite(self._start).all(1)
        if bad.any():
            self._start[bad, 1:] = simulator.initial_state[: self._physical]
        many = len(self._start) >= _ROWS_FOR_ALL_THREADS
        pool = simulator._pool if many else simulator._alone
        with _quiet():
            pool.rollout(
                self._repeated,
                simulator._data if many else simulator._data[:1],
                self._start,
                control,
                skip_checks=True,
                nstep=steps,
                state=trajectory,
                sensordata=sensors,
            )
        end = trajectory[:, -1]
        ended = _CLOCK + steps * self.models[0].opt.timestep
        failed = bad | (abs(end[:, 0] - ended) > 1e-9) | ~(abs(end) <= mujoco.mjMAXVAL).all(1)
        next_state = end[:, 1:].copy()
        next_state[failed] = np.nan
        return next_state.reshape(state.shape)

    def _check_shapes(self, state: tuple[int, ...], action: tuple[int, ...]) -> None:
        simulator, rows = self._simulator, state[1] if len(state) == 3 else 0
        size = self._physical + simulator.task.pending * simulator.action_size
        if state != (self.count, rows, size) or action != (self.count, rows, simulator.action_size):
            raise MadocError(
                f"expected states of shape ({self.count}, rows, {size}) and actions of shape "
                f"({self.count}, rows, {simulator.action_size}) for {simulator.task.name}, got {state} and {action}"
            )

    def _allocate(self, rows: int) -> None:
        if rows == self._rows:
            return
        simulator, model = self._simulator, self.models[0]
        total, steps = self.count * rows, simulator.task.frame_skip
        self._rows = rows
        self._weights = delay_weights(
            self._delay,
            control_step=simulator.control_step,
            physics_steps=steps,
            pending=simulator.task.pending,
        )
        self._repeated = [model for model in self.models for _ in range(rows)]
        self._start = np.full((total, 1 + self._physical), _CLOCK)
        self._control = np.zeros((total, steps, model.nu))
        self._trajectory = np.zeros((total, steps, 1 + self._physical))
        self._sensors = np.zeros((total, steps, model.nsensordata))


def _check_elements(model: mujoco.MjModel, task: Task, parameter: Parameter) -> None:
    """Refuse a parameter of an element that the model, or for a signal the task, does not have."""
    if FIELDS[parameter.field].element != "signal":
        find_elements(model, parameter)
        return
    for element in parameter.elements:
        if element not in task.signals:
            hint = nearest_hint(element, task.signals, none="none of its observation's values has a name")
            raise MadocError(f"{parameter.name}: {task.name} has no signal {element!r}; {hint}")


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress MuJoCo's warning about a row that diverges (on stderr and in MUJOCO_LOG.TXT): it comes back as NaN."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
