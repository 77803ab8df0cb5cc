"""What a task is: a model, and pure batched functions between state, observation, reward and end."""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import jax
import mujoco
from jaxtyping import PRNGKeyArray

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


def scaled_friction(spec: Callable[[], mujoco.MjSpec], factor: float) -> mujoco.MjSpec:
    """The spec with every geom's sliding friction times `factor`; a contact takes the larger of its two."""
    changed = spec()
    for geom in changed.geoms:
        geom.friction[0] *= factor
    return changed


@dataclass(frozen=True)
class ActionChannel:
    """One value of an action: which actuator it goes to, and what -1 and 1 mean there.

    Attributes:
        name: What its column is called.
        actuator: Name of the model's actuator.
        low: What an action of -1 stands for, in `unit`.
        high: What an action of 1 stands for, in `unit`.
        unit: Of `low`, `high` and the log's column.
        scale: The actuator's control is this many times the value in `unit`.
        rest: The action that is taken to have come before an episode begins.
    """

    name: str
    actuator: str
    low: float
    high: float
    unit: str
    scale: float = 1.0
    rest: float = 0.0


@dataclass(frozen=True)
class Task:
    """A robot and what is asked of it, without any truth about the target.

    The state is (qpos, qvel, pending actions), float64, on the last axis. Functions are pure and batched over leading
    axes.

    Attributes:
        name: `hopper`, ...
        physics: `legacy` (mujoco-py: D4RL, NeoRL, the paper) or `modern` (MuJoCo >= 2.1.1).
        spec: Builds the MuJoCo spec, at its nominal parameters.
        frame_skip: Physics steps per control step.
        observation_size: Values per observation.
        observe: state -> observation, where no sensor needs a system (`System.observe` does it for every robot).
        reward: (state, action, next_state) -> reward.
        terminated: next_state -> whether the task has ended there (a fall).
        reset_noise: (key, count) -> offsets (count, state_size) added to the model's initial state.
        parameters: What can be calibrated, with the paper's normal ranges.
        ranges: Other boxes by level (`easy`, `normal`, `hard`).
        groups: How many groups the paper forms for this robot.
        max_episode_steps: Time limit in control steps; reaching it truncates.
        reference_returns: Returns of (random, expert) for the normalized score, from D4RL.
        state_from_observation: observation -> (qpos, qvel); None where the observation does not determine them.
        rebuildable: observation -> whether `state_from_observation` is exact for that row.
        velocities: How many values at the end of an observation are velocities; 0 where they cannot be told apart.
        pending: How many past actions a state carries behind (qpos, qvel), newest first, each in [-1, 1].
        actions: What the values of an action mean; empty where they are the model's controls as they are.
        signals: Names of the observation's values; empty where they have none.
        sense: (state, sensordata) -> observation, where it reads the model's sensors.
        rewarded: Whether `reward` says anything; without it nothing can be learnt or judged.
        source: The files of a robot's spec as JSON, from which `robots.restore` makes the task again; None for a task
            that its name determines.
        posture: observation -> (qpos, qvel) as far as it tells, NaN elsewhere; None where it tells no position.
    """

    name: str
    physics: str
    spec: Callable[[], mujoco.MjSpec]
    frame_skip: int
    observation_size: int
    observe: Callable[[Batch], Batch]
    reward: Callable[[Batch, Batch, Batch], Batch]
    terminated: Callable[[Batch], Batch]
    reset_noise: Callable[[PRNGKeyArray, int], jax.Array]
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
    source: Mapping[str, Any] | None = None
    posture: Callable[[Batch], Batch] | None = None

    @property
    def action_size(self) -> int:
        """Values per action."""
        return len(self.actions) or int(self.model.nu)

    @property
    def model(self) -> mujoco.MjModel:
        """The model at nominal parameters, compiled once and shared: read it, and `compile` one to change."""
        return compiled_model(self.spec)

    def compile(self) -> mujoco.MjModel:
        """A copy of the model at nominal parameters, free to be changed."""
        return copy.copy(self.model)

    def with_level(self, level: str) -> "Task":
        """The same task searched in its `easy`, `normal` or `hard` ranges (the paper's appendix D).

        Raises:
            MadocError: No such level.
        """
        if level not in self.ranges:
            raise MadocError(f"no range level {level!r} for {self.name}; there are: {', '.join(self.ranges)}")
        return replace(self, parameters=self.ranges[level])

    def with_friction(self, factor: float) -> "Task":
        """The same task with the friction of every contact times `factor`."""
        return replace(self, spec=partial(scaled_friction, self.spec, factor))

    def with_parameters(self, names: list[str]) -> "Task":
        """The same task with only the named parameters calibratable."""
        return replace(self, parameters=self.parameters.select(names))
