"""The CPU backend: MuJoCo's own threaded rollout, all cores, float64."""

import copy
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial

import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Float, Int

from madoc.errors import MadocError, listed
from madoc.parameters import FIELDS
from madoc.runs.machine import usable_cores
from madoc.simulation.base import SIMULATED
from madoc.simulation.delay import LAGS, action_weights, blend
from madoc.simulation.joints import install_callbacks, needs_callbacks
from madoc.simulation.probes import collided, drive_forces, sensing_motion
from madoc.simulation.write import check_elements, conditions_of, write_parameters
from madoc.tasks.base import Task

_CLOCK = 1.0
"""Time in s at which every row starts its step; MuJoCo resets a simulation that diverges, which its clock shows."""

_STEPS_FOR_ALL_THREADS = 8
"""Number of control steps from which all threads simulate; with fewer, waking a second costs more than it saves."""
_CHUNKS = 2
"""Number of parts of a batch that each thread steps; with ten, the default, 200 rows take a tenth longer."""
_VALUES_AT_ONCE = 4_000_000
"""Number of values, beside the states returned, that a rollout may keep in memory; larger ones are done in parts."""


class CpuSimulator:
    """A task's MuJoCo model with calibratable parameters; as many cores as `threads`, by default all, step it.

    Raises:
        MadocError: A parameter names an element that the model does not have.
    """

    def __init__(self, task: Task, *, threads: int | None = None) -> None:
        self.task, self.parameters, self.action_size = task, task.parameters, task.action_size
        self.threads = threads or usable_cores()
        self._model = task.model
        if needs_callbacks(self._model):
            install_callbacks()
        self.control_step = float(self._model.opt.timestep) * task.frame_skip
        active = np.flatnonzero(self._model.actuator_actnum).tolist()
        if active:
            names = listed((self._model.actuator(index).name or f"number {index}" for index in active), most=4)
            raise MadocError(
                f"{task.name}: of the actuators {names} with an activation (dyntype) the state is not simulated here; "
                "take the dyntype out of the model, and calibrate action_lag or action_delay instead"
            )
        whole = mujoco.mj_stateSize(self._model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        if whole != 1 + self._model.nq + self._model.nv:  # time, positions, velocities
            raise MadocError(
                f"{task.name}: models whose actuators or sensors keep a history (delay, nsample), or plugins have "
                "a state, are not supported; take it out, and calibrate action_delay instead"
            )
        for parameter in task.parameters.parameters:
            check_elements(self._model, task, parameter)
        self._actuators = [self._model.actuator(channel.actuator).id for channel in task.actions]
        low, high, scale = (
            np.array([getattr(channel, name) for channel in task.actions]) for name in ("low", "high", "scale")
        )
        self._centre, self._half = scale * (low + high) / 2.0, scale * (high - low) / 2.0
        self._conditions = conditions_of(task.parameters.parameters)
        self._biased = any(parameter.field == "signal_bias" for parameter in task.parameters.parameters)
        self._data = [mujoco.MjData(self._model) for _ in range(self.threads)]
        self._pool = mujoco.rollout.Rollout(nthread=self.threads if self.threads > 1 else 0)
        self._alone = mujoco.rollout.Rollout(nthread=0)

    @property
    def initial_state(self) -> Float[np.ndarray, " state"]:
        """The model's (qpos0, 0), followed by the pending actions at rest, and goals of 0."""
        rest = [channel.rest for channel in self.task.actions] or self.action_size * [0.0]
        still, goals = np.zeros(self._model.nv), np.zeros(len(self.task.goals))
        return np.concatenate([self._model.qpos0, still, np.tile(rest, self.task.pending), goals])

    def bind(self, parameters: Float[np.ndarray, "*systems parameters"] | Mapping[str, float]) -> "CpuSystem":
        """A system for each row of physical values, or the one of a vector or of values by name.

        Raises:
            MadocError: Values are not finite, not one per parameter, or beyond a physical bound.
        """
        values = np.atleast_2d(self.parameters.vector(parameters))
        if values.ndim != 2:
            raise MadocError(f"expected parameters of shape (systems, {len(self.parameters)}), got {values.shape}")
        if not np.isfinite(values).all():
            raise MadocError("expected finite parameters, got NaN or infinity")
        for parameter, column in zip(self.parameters.parameters, values.T, strict=True):
            minimum = parameter.kind.minimum
            if (column < minimum).any():
                raise MadocError(
                    f"expected {parameter.name} of at least {minimum} {parameter.unit}, "
                    f"got {column.min()} in system {column.argmin()}"
                )
        models = []
        for row in values:
            models.append([copy.copy(self._model) for _ in self._conditions])
            for model, conditions in zip(models[-1], self._conditions, strict=True):
                write_parameters(model, self._data[0], self.parameters.parameters, row, conditions)
        delay, lag = self._of_actions(values, "action_delay"), self._of_actions(values, "action_lag")
        longest = self.task.pending * self.control_step
        late = float((delay + LAGS * lag).max(initial=0.0))
        if late > longest + 1e-9:
            of_lag = f" and {LAGS:g} times an action_lag" if lag.any() else ""
            raise MadocError(
                f"expected an action_delay{of_lag} of at most {longest:g} s, got {late:g}: a state of "
                f"{self.task.name} carries {self.task.pending} past actions; widen the range of "
                f"its {'action_lag' if of_lag else 'action_delay'}"
            )
        bias = self.parameters.summed(values, "signal_bias", self.task.signals)
        return CpuSystem(self, models, np.minimum(delay, longest), lag, bias)

    def _of_actions(
        self, values: Float[np.ndarray, "systems parameters"], field: str
    ) -> Float[np.ndarray, "systems values"]:
        """A delay or lag of each value of an action, or one of all where none has its own.

        What a drive takes from the log, as its supply, has no lag.
        """
        rows = [row for row in self.parameters.parameters if row.field == field]
        measured = [not channel.command for channel in self.task.actions] if field == "action_lag" else []
        if not any(row.elements for row in rows) and not (rows and any(measured)):
            return self.parameters.summed(values, field, [])
        sums = self.parameters.summed(values, field, [channel.name for channel in self.task.actions])
        return np.where(measured or False, 0.0, sums)

    def _controls(self, action: Float[np.ndarray, "*rows action"]) -> Float[np.ndarray, "*rows control"]:
        """Controls of the model's actuators for an action; 0 for actuators that no action channel drives."""
        if not self.task.actions:
            return action
        control = np.zeros((*action.shape[:-1], self._model.nu))
        control[..., self._actuators] = self._centre + self._half * action
        return control

    def _under(self, control: Float[np.ndarray, "systems rows control"]) -> Int[np.ndarray, "systems rows"]:
        """Index of the conditions under which each row runs, which its controls bring in."""
        under = np.zeros(control.shape[:2], dtype=np.int64)
        for name in self._conditions[0]:
            values = [value for value in dict.fromkeys(each[name] for each in self._conditions) if value is not None]
            same = np.isclose(control[..., self._model.actuator(name).id, None], values, rtol=1e-9, atol=1e-12)
            place = np.where(same.any(-1), same.argmax(-1), len(values))  # the last is that of any other value
            under = under * (len(values) + 1) + place
        return under

    def contacts(
        self, state: Float[np.ndarray, "rows state"], values: Float[np.ndarray, " parameters"] | None = None
    ) -> Int[np.ndarray, " rows"]:
        """Number of pairs of geoms in contact in each state, at physical values, which are mid-range unless given."""
        moving = ("jnt_ref", "body_distance")
        placed = any(row.field in moving or row.field not in FIELDS for row in self.parameters.parameters)
        model = self.model(self.parameters.middle if values is None else values) if placed else self._model
        contacts = np.zeros(len(state), dtype=np.int64)
        for row, data in enumerate(collided(model, self._data[0], state)):
            contacts[row] = len(set(map(tuple, data.contact.geom.tolist()))) if data.ncon > 1 else data.ncon
        return contacts

    def model(self, values: Float[np.ndarray, " parameters"]) -> mujoco.MjModel:
        """A MuJoCo model at the given physical values, owned by the caller."""
        return self.bind(np.asarray(values)[None]).models[0]


class CpuSystem:
    """Systems at fixed parameters; states are (qpos, qvel, pending actions, goals).

    The solver's warm start is 0 where a step or a rollout begins, so what follows depends on the state, the actions and
    the parameters alone, whatever the number of threads.
    """

    def __init__(
        self,
        simulator: CpuSimulator,
        models: list[list[mujoco.MjModel]],
        delay: Float[np.ndarray, "systems values"],
        lag: Float[np.ndarray, "systems other_values"],
        bias: Float[np.ndarray, "systems signals"],
    ) -> None:
        self.models, self.count, self._models = [row[0] for row in models], len(models), models
        self._simulator, self._delay, self._lag, self._bias = simulator, *np.broadcast_arrays(delay, lag), bias
        self._physical = self.models[0].nq + self.models[0].nv
        self._goals = self._physical + simulator.task.pending * simulator.action_size
        weights = partial(
            action_weights,
            self._delay,
            self._lag,
            control_step=simulator.control_step,
            physics_steps=simulator.task.frame_skip,
        )
        self._weights = weights(pending=simulator.task.pending)
        # What sensors show is the end of a control step, whose own action is the newest of those pending.
        self._sensed = weights(pending=max(simulator.task.pending - 1, 0))[:, -1:]

    def replaced(
        self, systems: Int[np.ndarray, " some"], parameters: Float[np.ndarray, "some parameters"]
    ) -> "CpuSystem":
        """These systems, with those of the given indices bound to other parameters."""
        new, models = self._simulator.bind(parameters), list(self._models)
        for index, model in zip(systems, new._models, strict=True):
            models[index] = model
        delay, lag, bias = self._delay.copy(), self._lag.copy(), self._bias.copy()
        delay[systems], lag[systems], bias[systems] = new._delay, new._lag, new._bias
        return CpuSystem(self._simulator, models, delay, lag, bias)

    def step(
        self,
        state: Float[np.ndarray, "..."],
        action: Float[np.ndarray, "..."],
        force: Float[np.ndarray, "systems rows dof"] | None = None,
    ) -> Float[np.ndarray, "..."]:
        """One control step of `frame_skip` physics steps; other shapes than (systems, rows, values) are refused."""
        return self.roll_out(state, action[:, :, None], None if force is None else force[:, :, None])[:, :, 0]

    def roll_out(
        self,
        state: Float[np.ndarray, "..."],
        actions: Float[np.ndarray, "..."],
        force: Float[np.ndarray, "systems rows steps dof"] | None = None,
    ) -> Float[np.ndarray, "systems rows steps state"]:
        """The state after each of the actions of shape (systems, rows, steps, action); NaN from where it diverges."""
        self._check_shapes(state.shape, (*actions.shape[:2], *actions.shape[3:]))
        (count, rows, steps, _), pending = actions.shape, self._simulator.task.pending
        SIMULATED.control_steps += count * rows * steps
        values = 1 + self._physical + self.models[0].nu + self.models[0].nv + (2 + pending) * actions.shape[-1]
        most = _VALUES_AT_ONCE // max(1, count * steps * self._simulator.task.frame_skip * values)
        if most >= rows:
            return self._roll_out_part(state, actions, force)
        after = np.empty((count, rows, steps, state.shape[-1]))
        for part in np.array_split(np.arange(rows), -(-rows // max(1, most))):
            after[:, part] = self._roll_out_part(
                state[:, part], actions[:, part], None if force is None else force[:, part]
            )
        return after

    def _roll_out_part(
        self,
        state: Float[np.ndarray, "systems rows state"],
        actions: Float[np.ndarray, "systems rows steps action"],
        force: Float[np.ndarray, "systems rows steps dof"] | None,
    ) -> Float[np.ndarray, "systems rows steps state"]:
        (count, rows, steps, _), physics_steps = actions.shape, self._simulator.task.frame_skip
        history = self._histories(state, actions)
        given = blend(self._weights, history.reshape(count, rows * steps, *history.shape[3:]))
        control = self._simulator._controls(given.reshape(count, rows, steps * physics_steps, given.shape[-1]))
        held = None if force is None else np.repeat(force, physics_steps, axis=2)
        moved = self._simulated(state[..., : self._physical], control, held)[:, :, physics_steps - 1 :: physics_steps]
        if state.shape[-1] == self._physical:
            return moved
        pending = history[..., :-1, :].reshape(count, rows, steps, self._goals - self._physical)
        goals = np.repeat(state[:, :, None, self._goals :], steps, axis=2)
        kept = np.concatenate([pending, goals], axis=-1)
        return np.concatenate([moved, np.where(np.isnan(moved[..., :1]), np.nan, kept)], axis=-1)

    def observe(self, state: Float[np.ndarray, "systems rows state"]) -> Float[np.ndarray, "systems rows observation"]:
        """Observations with each system's bias; NaN where a state is NaN.

        A sensor of the model is read in a forward pass under the control that is in effect, where the state carries it
        (`Task.pending`), else under no control.
        """
        task = self._simulator.task
        seen = task.observe(state) if task.sense is None else task.sense(state, self._sensordata(state))
        return seen + self._bias[:, None] if self._simulator._biased else seen

    def actuator_forces(
        self, state: Float[np.ndarray, "systems rows state"], action: Float[np.ndarray, "systems rows action"]
    ) -> Float[np.ndarray, "systems rows actuator dof"]:
        """What each actuator exerts on every degree of freedom at the start of a step, in N or N·m."""
        history = self._histories(state, action[:, :, None])[:, :, 0]
        control = self._simulator._controls(blend(self._weights, history))[:, :, 0]
        models = self._models_of(control)
        return np.stack([drive_forces(*each) for each in zip(models, state, control, strict=True)])

    def unbiased(self, state: Float[np.ndarray, "systems rows state"]) -> Float[np.ndarray, "systems rows state"]:
        """States rebuilt from logged observations, corrected for the bias of each system's sensors."""
        rebuild = self._simulator.task.state_from_observation or self._simulator.task.posture
        if rebuild is None or not self._simulator._biased:
            return state
        shift = np.zeros((self.count, 1, state.shape[-1]))
        shift[:, 0, : self._physical] = np.nan_to_num(rebuild(self._bias) - rebuild(np.zeros_like(self._bias)))
        return state - shift

    def _sensordata(self, state: Float[np.ndarray, "systems rows state"]) -> Float[np.ndarray, "systems rows sensor"]:
        control = np.zeros((*state.shape[:2], 1, self.models[0].nu))
        if self._simulator.task.pending:
            control = self._simulator._controls(blend(self._sensed, self._pending(state)))
        sensors = np.zeros((control.shape[0] * control.shape[1], 1, self.models[0].nsensordata))
        with sensing_motion([model for row in self._models for model in row]):
            moved = self._simulated(state[..., : self._physical], control, sensors=sensors)
        return np.where(np.isnan(moved[:, :, 0, :1]), np.nan, sensors.reshape(*control.shape[:2], -1))

    def _models_of(self, control: Float[np.ndarray, "systems rows control"]) -> list[list[mujoco.MjModel]]:
        """The model of every row."""
        under = self._simulator._under(control).tolist()
        return [[own[index] for index in rows] for own, rows in zip(self._models, under, strict=True)]

    def _histories(
        self, state: Float[np.ndarray, "systems rows state"], actions: Float[np.ndarray, "systems rows steps action"]
    ) -> Float[np.ndarray, "systems rows steps actions action"]:
        """Each of the actions with those before it that are pending, newest first."""
        pending, steps = self._simulator.task.pending, actions.shape[2]
        if not pending:
            return actions[:, :, :, None]
        taken = np.concatenate([self._pending(state)[:, :, ::-1], actions], axis=2)
        return taken[:, :, pending + np.arange(steps)[:, None] - np.arange(pending + 1)]

    def _pending(
        self, state: Float[np.ndarray, "systems rows state"]
    ) -> Float[np.ndarray, "systems rows pending action"]:
        """Past actions, newest first."""
        sizes = self._simulator.task.pending, self._simulator.action_size
        return state[..., self._physical : self._goals].reshape(*state.shape[:2], *sizes)

    def _simulated(
        self,
        state: Float[np.ndarray, "systems rows physical"],
        control: Float[np.ndarray, "systems rows physics_steps control"],
        force: Float[np.ndarray, "systems rows physics_steps dof"] | None = None,
        sensors: Float[np.ndarray, "all_rows physics_steps sensor"] | None = None,
    ) -> Float[np.ndarray, "systems rows physics_steps physical"]:
        """States after each physics step, NaN from where they diverge; `sensors` are filled with what sensors read."""
        simulator, (count, rows, physics_steps, _) = self._simulator, control.shape
        total, inputs = count * rows, mujoco.mjtState.mjSTATE_CTRL
        if force is not None:
            inputs |= mujoco.mjtState.mjSTATE_QFRC_APPLIED
            control = np.concatenate([control, force], axis=-1)
        if not total:
            return np.zeros((count, rows, physics_steps, self._physical))
        models = [model for row in self._models_of(control[:, :, 0]) for model in row]
        control = control.reshape(total, physics_steps, -1)
        start = np.full((total, 1 + self._physical), _CLOCK)
        start[:, 1:] = state.reshape(total, -1)
        good = np.logical_and.reduce(np.isfinite(start), axis=1)
        if not good.all():
            start[~good, 1:] = simulator.initial_state[: self._physical]
        many = total > 1 and total * physics_steps >= _STEPS_FOR_ALL_THREADS * simulator.task.frame_skip
        trajectory = np.zeros((total, physics_steps, 1 + self._physical))
        with without_warnings():
            (simulator._pool if many else simulator._alone).rollout(
                models,
                simulator._data if many else simulator._data[:1],
                start,
                control,
                control_spec=inputs,
                skip_checks=True,
                nstep=physics_steps,
                chunk_size=-(-total // (_CHUNKS * simulator.threads)),
                state=trajectory,
                sensordata=sensors,
            )
        timestep = self.models[0].opt.timestep
        on_time = abs(trajectory[..., 0] - _CLOCK - timestep * np.arange(1, physics_steps + 1)) < timestep / 2
        succeeded = on_time & (abs(trajectory) <= mujoco.mjMAXVAL).all(-1) & np.isfinite(control).all(-1)
        succeeded = np.logical_and.accumulate(succeeded & good[:, None], axis=1)
        after = np.where(succeeded[..., None], trajectory[..., 1:], np.nan)
        return after.reshape(count, rows, physics_steps, self._physical)

    def _check_shapes(self, state: tuple[int, ...], action: tuple[int, ...]) -> None:
        simulator, rows = self._simulator, state[1] if len(state) == 3 else 0
        size = self._goals + len(simulator.task.goals)
        if state != (self.count, rows, size) or action != (self.count, rows, simulator.action_size):
            raise MadocError(
                f"expected states of shape ({self.count}, rows, {size}) and actions of shape "
                f"({self.count}, rows, {simulator.action_size}) for {simulator.task.name}, got {state} and {action}"
            )


@contextmanager
def without_warnings() -> Iterator[None]:
    """Suppress MuJoCo's warning about a row that diverges (on stderr and in MUJOCO_LOG.TXT): it comes back as NaN."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
