"""A robot made of its spec and its model."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import jax
import mujoco
import numpy as np
from jaxtyping import PRNGKeyArray

from madoc import simulation
from madoc.errors import MadocError
from madoc.robots.drives import (
    action_channel,
    added_actuator,
    check_gears,
    check_timestep,
    idle_actuators,
    joint_frictions,
    with_inputs,
)
from madoc.robots.episodes import Episode, no_reward, read_episode
from madoc.robots.functions import PythonFile
from madoc.robots.model import Draft, compiled, make_model, read_model, with_whole_inertia
from madoc.robots.model_files import ModelFiles
from madoc.robots.signals import attitudes_of, quaternion_of, read_signals, signal_unit, turn_of
from madoc.robots.space import parameter_space
from madoc.robots.spec import SHORTEST_TIMESTEP, RobotSpec, read_spec
from madoc.simulation.delay import pending_actions
from madoc.simulation.write import diagonal_bodies
from madoc.tasks.base import ActionChannel, Batch, Task, never_terminated

LONGEST_TIMESTEP = 1.0
"""Longest timestep in s; no robot is stable with one a tenth as long."""
MOST_STEPS = 10_000
"""Largest number of physics steps of a control step."""
MOST_PENDING = 1000
"""Largest number of control steps that an action may be late."""


@dataclass(frozen=True)
class Signal:
    """One value of an observation: its name, its unit, and the expression it is.

    `turn` is the change of its value in a turn of the hinge whose position it is; 0 where it is none. `quaternion` is
    the free or ball joint, or the sensor, of whose quaternion it is a component; empty where it is none.
    """

    name: str
    unit: str
    reads: str
    turn: float = 0.0
    quaternion: str = ""


@dataclass(frozen=True)
class Robot:
    """A robot that a user describes in a spec file, as a task like any other.

    Sentences say which positions and velocities an observation leaves `undetermined`, and what else a user should know.
    A run folder keeps all of the model's files.
    """

    path: Path
    spec: RobotSpec
    task: Task
    signals: tuple[Signal, ...]
    undetermined: tuple[str, ...]
    notes: tuple[str, ...]
    model_files: tuple[str, ...]

    @property
    def actions(self) -> tuple[ActionChannel, ...]:
        """The values of an action, in order; data has them in [-1, 1] of `low` and `high`."""
        return self.task.actions


@lru_cache(maxsize=32)
def make_robot(content: bytes, file: str, files: ModelFiles, python: PythonFile | None = None) -> Robot:
    """The robot that a spec describes; of the same content, the same robot. A mistake is refused with its line.

    The Python file is that which the spec names; it is run.
    """
    spec, document = read_spec(content, file)
    if spec.python is not None and python is None:
        raise document.error(("python",), f"the Python file {spec.python} is missing; restore it")
    with document.at("model"):
        draft = Draft(spec, document, read_model(files), python)
    _check_names(draft)
    try:
        factory, model, inputs = _model(draft, files.main)
    except MadocError:
        with document.at("model"):  # where the file does not compile by itself, the mistake is there
            compiled(draft.base.copy, files.main)
        raise
    signals = read_signals(draft, model)
    actions = (*(action_channel(draft, model, index) for index in range(len(spec.actions))), *inputs)
    if draft.base.actuators and not spec.actions:
        own = ", ".join(actuator.name or "without a name" for actuator in draft.base.actuators)
        raise draft.document.error(
            ("actions",), f"expected actions, as the model has the actuators {own}; list them, or take them out of it"
        )
    space, frame_skip = parameter_space(draft, model), _frame_skip(draft, model)
    check_timestep(draft, model, space)
    single = tuple(dict.fromkeys(name for row in space.parameters for name in diagonal_bodies(model, row)))
    if single:
        factory = partial(with_whole_inertia, factory, single)
        model = compiled(factory, files.main)
    delay, lag = (
        max((row.high for row in space.parameters if row.field == field), default=0.0)
        for field in ("action_delay", "action_lag")
    )
    pending = pending_actions(delay, lag, spec.control_step)
    if pending > MOST_PENDING:
        raise document.error(
            ("parameters",),
            f"expected action_delay and six times action_lag of at most {MOST_PENDING:,} control steps, got "
            f"{pending:,}; are they in seconds?",
        )
    if signals.read_sensors & signals.layout.accelerating:
        # Such a sensor shows the force in the last physics step, where the action before may hold yet.
        pending = max(pending, pending_actions(delay + float(model.opt.timestep), lag, spec.control_step))
    names, episode = tuple(signal.name for signal in spec.signals), read_episode(draft, signals, actions)
    if inputs and episode.rewarded:
        raise document.error(
            ("python",) if spec.reward is None else ("reward",),
            f"a policy cannot be learnt where drives take {', '.join(each.name for each in inputs)} from the log, as "
            "it would choose them: for that, give the drives fixed numbers",
        )
    task = Task(
        name=spec.name,
        physics="modern",
        spec=factory,
        frame_skip=frame_skip,
        observation_size=len(names),
        observe=partial(_needs_a_system, spec.name) if signals.read_sensors else signals.observe,
        reward=no_reward if episode.goals else episode.reward,
        terminated=never_terminated,
        reset_noise=partial(_no_noise, size=model.nq + model.nv + pending * len(actions)),
        parameters=space,
        ranges={"normal": space},
        groups=spec.groups or min(4, len(space)),
        max_episode_steps=spec.max_episode_steps,
        reference_returns=(0.0, 100.0),
        state_from_observation=signals.rebuild(),
        posture=signals.posture(),
        attitudes=attitudes_of(model, signals.expressions),
        pending=pending,
        actions=actions,
        signals=names,
        sense=signals.observe if signals.read_sensors else None,
        rewarded=episode.rewarded,
        source={"file": file, "spec": content.decode("utf-8-sig"), "model": files.to_json()}
        | ({} if python is None else {"python": python.to_json()}),
    )
    if episode.differs:
        task = replace(task, episodes=_episodes(task, episode))
    with document.at("model"):
        simulation.make(task, threads=1)
    if python is not None:
        with document.at("python"):
            _try_out(task.for_policies)
    shown = tuple(
        Signal(
            given.name,
            signal_unit(draft, model, expression, index),
            expression.text,
            turn_of(model, expression),
            quaternion_of(model, expression),
        )
        for index, (given, expression) in enumerate(zip(spec.signals, signals.expressions, strict=True))
    )
    used = {line.by for line in spec.parameters} | {channel.name for channel in inputs}
    unused = (condition.name for condition in spec.conditions if condition.name not in used)
    notes = (
        *idle_actuators(model, actions),
        *(f"the condition {name} has no effect: no by: and no gain_from: names it" for name in unused),
    )
    return Robot(Path(file), spec, task, shown, signals.undetermined(), notes, tuple(name for name, _ in files.files))


def _model(draft: Draft, file: str) -> tuple[Callable[[], mujoco.MjSpec], mujoco.MjModel, tuple[ActionChannel, ...]]:
    """The function that builds the MuJoCo spec with the added actuators, its model, and what drives take from a log."""
    actuators = [added_actuator(draft, index) for index in range(len(draft.spec.actions))]
    added, inputs = with_inputs(draft, tuple(actuator for actuator in actuators if actuator is not None))
    check_gears(draft)
    factory = partial(
        make_model, draft.base, added, draft.spec.timestep, joint_frictions(draft), tuple(draft.spec.gears)
    )
    with draft.document.at("actions"):
        return factory, compiled(factory, file), inputs


def _check_names(draft: Draft) -> None:
    """Refuse a name given to two signals or actions, a log column for a name that neither has, or for two signals."""
    names: dict[str, tuple[str, int]] = {}
    for kind in ("signals", "actions"):
        for index, part in enumerate(getattr(draft.spec, kind)):
            place = (kind, index, "name")
            if part.name in names:
                line = draft.document.line((*names[part.name], "name"))
                raise draft.document.error(place, f"the name {part.name!r} is taken by line {line}; choose another")
            names[part.name] = (kind, index)
    for name in draft.spec.log.columns:
        if name not in names:
            raise draft.document.unknown(("log", "columns", name), "the name of a signal or an action", name, names)
    of_column: dict[str, str] = {}
    for part in draft.spec.signals:  # one command may drive two actuators
        column = draft.spec.log.columns.get(part.name, part.name)
        other = of_column.setdefault(column, part.name)
        if other != part.name:
            named = part.name if part.name in draft.spec.log.columns else other
            raise draft.document.error(
                ("log", "columns", named),
                f"{other} and {part.name} are both read from the column {column!r}; name a column of its own for each, "
                "or leave one of them out",
            )


def _frame_skip(draft: Draft, model: mujoco.MjModel) -> int:
    """Physics steps of a control step."""
    timestep, wanted = float(model.opt.timestep), draft.spec.control_step
    if not SHORTEST_TIMESTEP <= timestep <= LONGEST_TIMESTEP:
        raise draft.document.error(
            ("model",) if draft.spec.timestep is None else ("timestep",),
            f"expected a timestep from {SHORTEST_TIMESTEP:g} to {LONGEST_TIMESTEP:g} s, got {timestep:g}; change it",
        )
    if wanted > MOST_STEPS * timestep:
        raise draft.document.error(
            ("control_step",),
            f"expected a control_step of at most {MOST_STEPS:,} timesteps of {timestep:g} s, got {wanted:g} s; "
            "give a longer timestep:",
        )
    steps = round(wanted / timestep)
    if steps < 1 or abs(steps * timestep - wanted) > 1e-6 * wanted:
        near = max(1, steps) * timestep
        raise draft.document.error(
            ("control_step",),
            f"expected control_step as a whole multiple of the timestep {timestep:g} s, got {wanted:g} s; "
            f"nearest: {near:g}, or give a timestep: that divides it",
        )
    return steps


def _episodes(task: Task, episode: Episode) -> Task:
    """The task that policies learn: begun, rewarded and ended as the spec says, with its goals behind the signals."""
    count = len(episode.goals)
    start = np.concatenate([simulation.make(task, threads=1).initial_state, np.zeros(count)])
    return replace(
        task,
        observation_size=task.observation_size + count,
        observe=partial(_with_goals, task.observe, count=count),
        reward=episode.reward,
        terminated=episode.ended,
        reset_noise=partial(episode.starts.offsets, start=start),
        traced_reset=episode.starts.function is None,
        state_from_observation=None if count else task.state_from_observation,
        posture=None if count else task.posture,
        signals=(*task.signals, *episode.goals),
        sense=task.sense and partial(_with_goals, task.sense, count=count),
        goals=episode.goals,
    )


def _try_out(task: Task) -> None:
    """Call what a Python file may define with a few rows, as a mistake there should not wait for a policy."""
    states = np.tile(simulation.make(task, threads=1).initial_state, (2, 3, 1))
    task.reward(states, np.zeros((2, 3, len(task.actions))), states)
    task.terminated(states)
    task.reset_noise(jax.random.key(0), 3)


def _with_goals(observe: Callable[..., Batch], state: Batch, *sensordata: Batch, count: int) -> Batch:
    """An observation with the goals, which end the state, behind it."""
    seen = observe(state, *sensordata)
    return state.__array_namespace__().concat([seen, state[..., state.shape[-1] - count :]], axis=-1)


def _no_noise(key: PRNGKeyArray, count: int, *, size: int) -> jax.Array:
    return jax.numpy.zeros((count, size))


def _needs_a_system(name: str, state: Batch) -> Batch:
    raise MadocError(f"an observation of {name} reads sensors of its model, so only a bound system can make it")
