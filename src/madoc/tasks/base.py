"""A task: a model, and pure batched functions of state, observation, reward and termination."""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import jax
import mujoco
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.errors import MadocError
from madoc.parameters import ParameterSpace

Batch = Any
"""A NumPy or JAX array with any leading axes; the functions of a task work on both, so every backend shares them."""

_MODELS: WeakKeyDictionary[Callable[[], mujoco.MjSpec], mujoco.MjModel] = WeakKeyDictionary()
"""Compiled models by the function that builds their spec; a model is dropped together with its function."""


def compiled_model(spec: Callable[[], mujoco.MjSpec]) -> mujoco.MjModel:
    """The model of a spec, compiled once for each function that builds it. It is shared, so nobody may change it."""
    if spec not in _MODELS:
        _MODELS[spec] = spec().compile()
    return _MODELS[spec]


def scaled_time_step(spec: Callable[[], mujoco.MjSpec], factor: float) -> mujoco.MjSpec:
    """The spec with the integration step times `factor`."""
    changed = spec()
    changed.option.timestep *= factor
    return changed


def tilted(spec: Callable[[], mujoco.MjSpec], axis: int, angle: float) -> mujoco.MjSpec:
    """The spec with gravity tilted towards an axis, 0 for x and 1 for y, by an angle in rad."""
    changed = spec()
    changed.option.gravity[axis] += np.linalg.norm(changed.option.gravity) * np.sin(angle)
    return changed


def scaled_friction(spec: Callable[[], mujoco.MjSpec], factor: float) -> mujoco.MjSpec:
    """The spec with every geom's sliding friction times `factor`; a contact takes the larger of its two."""
    changed = spec()
    for geom in changed.geoms:
        geom.friction[0] *= factor
    return changed


def never_terminated(next_state: Batch) -> Batch:
    """False for every row."""
    return next_state.__array_namespace__().zeros(next_state.shape[:-1], dtype=bool)


@dataclass(frozen=True)
class ActionChannel:
    """One value of an action: its actuator, and the values that -1 and 1 stand for.

    Attributes:
        name: Name of the value and of its column in a log.
        actuator: Name of the model's actuator.
        low: The value of an action of -1, in `unit`.
        high: The value of an action of 1, in `unit`.
        unit: The unit of `low`, `high` and the log's column.
        scale: Ratio of the actuator's control to the value in `unit`.
        rest: The action assumed before an episode begins, in [-1, 1].
        command: Whether it asks the robot for something; a supply that was measured, say, only tells of the drive.
    """

    name: str
    actuator: str
    low: float
    high: float
    unit: str
    scale: float = 1.0
    rest: float = 0.0
    command: bool = True


@dataclass(frozen=True)
class Task:
    """A robot and its reward, without the true parameters of the target.

    The state is (qpos, qvel, pending actions, goals), float64, on the last axis. Functions are pure and batched over
    leading axes.

    Attributes:
        name: `hopper`, ...
        physics: `legacy` (mujoco-py: D4RL, NeoRL, the paper) or `modern` (MuJoCo >= 2.1.1).
        spec: Builds the MuJoCo spec, at its nominal parameters.
        frame_skip: Physics steps per control step.
        observation_size: Values per observation.
        observe: state -> observation, for a task without `sense` (`System.observe` works for every task).
        reward: (state, action, next_state) -> reward.
        terminated: next_state -> whether the task has ended there (a fall).
        reset_noise: (key, count) -> offsets (count, state_size) added to the model's initial state.
        parameters: What can be calibrated, with the paper's normal ranges.
        ranges: Other boxes by level (`easy`, `normal`, `hard`).
        groups: Number of parameter groups that Madoc's VAE forms.
        max_episode_steps: Time limit in control steps; reaching it truncates.
        reference_returns: Returns of (random, expert) for the normalized score, from D4RL.
        state_from_observation: observation -> (qpos, qvel); None where the observation does not determine them.
        rebuildable: observation -> whether `state_from_observation` is exact for that row.
        velocities: Number of velocities at the end of an observation; 0 where they are not there in one block.
        pending: Number of past actions in a state behind (qpos, qvel), newest first, each in [-1, 1].
        actions: The channels of an action; empty where its values are the model's controls.
        signals: Names of the observation's values; empty where they have none.
        sense: (state, sensordata) -> observation, where it reads the model's sensors.
        rewarded: Whether the task has a reward; without one no policy can be learnt or evaluated.
        source: The files of a robot's spec as JSON, from which `robots.restore` makes the task again; None for a task
            that its name determines.
        goals: Names of the values that are drawn at a reset, hold for an episode, and end state and observation.
        traced_reset: Whether JAX may trace `reset_noise`; not where a function of a user's own draws with NumPy.
        episodes: The task that policies learn, where a user's own robot starts, ends or is rewarded there unlike in
            its logs; None where it is this one. `for_policies` has the parameters as well.
        posture: observation -> (qpos, qvel), NaN for values not determined; None where no position is determined.
        attitudes: Of each quaternion that an observation shows the indices of its values w, x, y and z.
    """

    name: str
    physics: str
    spec: Callable[[], mujoco.MjSpec]
    frame_skip: int
    observation_size: int
    observe: Callable[[Batch], Batch]
    reward: Callable[[Batch, Batch, Batch], Batch]
    terminated: Callable[[Batch], Batch]
    reset_noise: Callable[[PRNGKeyArray, int], jax.Array | np.ndarray]
    parameters: ParameterSpace
    ranges: dict[str, ParameterSpace]
    groups: int
    max_episode_steps: int
    reference_returns: tuple[float, float]
    state_from_observation: Callable[[Batch], Batch] | None = None
    rebuildable: Callable[[Batch], Batch] | None = None
    velocities: int = 0
    pending: int = 0
    actions: tuple[ActionChannel, ...] = ()
    signals: tuple[str, ...] = ()
    sense: Callable[[Batch, Batch], Batch] | None = None
    rewarded: bool = True
    source: Mapping[str, object] | None = None
    posture: Callable[[Batch], Batch] | None = None
    attitudes: tuple[tuple[int, int, int, int], ...] = ()
    goals: tuple[str, ...] = ()
    traced_reset: bool = True
    episodes: "Task | None" = None

    @property
    def action_size(self) -> int:
        """Values per action."""
        return len(self.actions) or int(self.model.nu)

    @property
    def action_ranges(self) -> tuple[Float[np.ndarray, " action"], Float[np.ndarray, " action"]]:
        """Middle and half of each action's range in the unit of its channel; 0 and 1 without channels."""
        low, high = (np.array([getattr(channel, end) for channel in self.actions]) for end in ("low", "high"))
        if not self.actions:
            return np.zeros(self.action_size), np.ones(self.action_size)
        return (high + low) / 2.0, (high - low) / 2.0

    @property
    def model(self) -> mujoco.MjModel:
        """The model at nominal parameters, compiled once and shared: read it, and `compile` one to change."""
        return compiled_model(self.spec)

    def compile(self) -> mujoco.MjModel:
        """A copy of the model at nominal parameters, free to be changed."""
        return copy.copy(self.model)

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Names of an observation's values."""
        return self.signals or tuple(f"observation[{index}]" for index in range(self.observation_size))

    @property
    def for_policies(self) -> "Task":
        """The task that policies learn and are evaluated in, with the same parameters."""
        return self if self.episodes is None else replace(self.episodes, parameters=self.parameters, ranges=self.ranges)

    def with_level(self, level: str) -> "Task":
        """The same task searched in its `easy`, `normal` or `hard` ranges (appendix D, Jiang et al. 2024)."""
        if level not in self.ranges:
            raise MadocError(f"no range level {level!r} for {self.name}; there are: {', '.join(self.ranges)}")
        return replace(self, parameters=self.ranges[level])

    def with_friction(self, factor: float) -> "Task":
        """The same task with the friction of every contact times `factor`."""
        return replace(self, spec=partial(scaled_friction, self.spec, factor))

    def with_time_step(self, factor: float, *, substeps: int = 1) -> "Task":
        """The same task with the integration step times `factor`, and `substeps` times as many a control step.

        Its model is a copy of this one's: a second compilation may take seconds, and would differ by that number alone.
        """
        spec = partial(scaled_time_step, self.spec, factor)
        _MODELS[spec] = self.compile()
        _MODELS[spec].opt.timestep *= factor
        return replace(self, spec=spec, frame_skip=self.frame_skip * substeps)

    def with_tilt(self, axis: int, angle: float) -> "Task":
        """The same task on a base that is tilted by an angle in rad, so that gravity points towards an axis, x or y."""
        spec = partial(tilted, self.spec, axis, angle)
        _MODELS[spec] = self.compile()
        _MODELS[spec].opt.gravity[axis] += np.linalg.norm(_MODELS[spec].opt.gravity) * np.sin(angle)
        return replace(self, spec=spec)

    def with_parameters(self, names: list[str]) -> "Task":
        """The same task with only the named parameters calibratable."""
        return replace(self, parameters=self.parameters.select(names))
