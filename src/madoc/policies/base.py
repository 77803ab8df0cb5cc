"""What a policy learner is given, and what it must offer."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from madoc.data import Dataset
from madoc.errors import MadocError
from madoc.learning.features import Features
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.policies.systems import ParameterDistribution
from madoc.simulation.base import Simulator
from madoc.tasks.base import Task
from madoc.types import Method, State


@dataclass(frozen=True)
class PolicyProblem:
    """Learn a policy in these systems.

    The data's true parameters, where it carries any, are dropped here: no method can read them.

    Attributes:
        simulator: The source domain.
        parameters: Physical values of one system, by name or as a vector (d,), or of several, one in each row. Or a
            distribution that systems are drawn from.
        dataset: Logged transitions, for learners that use them.

    Raises:
        MadocError: Parameters or data are another robot's.
    """

    simulator: Simulator
    parameters: Float[np.ndarray, "systems parameters"] | Mapping[str, float] | ParameterDistribution
    dataset: Dataset | None = None

    def __post_init__(self) -> None:
        task = self.simulator.task
        space = self.simulator.parameters
        if not isinstance(self.parameters, ParameterDistribution):
            object.__setattr__(self, "parameters", np.atleast_2d(space.vector(self.parameters)))
        elif self.parameters.size != len(space):
            raise MadocError(f"expected {len(space)} parameter values for {task.name}, got {self.parameters.size}")
        if self.dataset is not None:
            if self.dataset.task_name != task.name:
                raise MadocError(f"the data was recorded from {self.dataset.task_name}, the simulator is {task.name}")
            logged = self.dataset.transitions.observation.shape[-1]
            if logged != task.observation_size:
                raise MadocError(
                    f"the data has {logged} values per observation, the simulator's {task.name} shows "
                    f"{task.observation_size}; give data and simulator of the same observation"
                )
            object.__setattr__(self, "dataset", replace(self.dataset, true_parameters=None))

    @cached_property
    def logged(self) -> dict[str, Array]:
        """The columns of the dataset that learners use, on the device, float32: what `replay.sample` gives of rows.

        Raises:
            MadocError: There is no dataset.
        """
        rows = self._data.transitions
        columns = ("observation", "action", "reward", "next_observation", "terminated")
        return {name: jnp.asarray(getattr(rows, name), jnp.float32) for name in columns}

    @cached_property
    def features(self) -> Features:
        """How networks see the data's (s, a) and s'.

        Raises:
            MadocError: There is no dataset.
        """
        return Features.of(self._data.transitions)

    @property
    def _data(self) -> Dataset:
        if self.dataset is None:
            raise MadocError("this problem has no data; give it a dataset")
        return self.dataset

    def systems(self, key: PRNGKeyArray, count: int) -> Float[np.ndarray, "systems parameters"]:
        """Physical values of the systems to act in next: the fixed ones, or `count` fresh draws."""
        parameters = self.parameters
        if isinstance(parameters, ParameterDistribution):
            return parameters.draw(key, count)
        return self.simulator.parameters.vector(parameters)


def require_data(problem: PolicyProblem, *, rows: int, outcomes: bool = True) -> Dataset:
    """The dataset, refused where a learner could not use it.

    Raises:
        MadocError: There is none, or it has fewer than `rows` rows. Or `outcomes` are learnt from, r and s' of a
            row, and all rewards are 0 or next observations are another row's.
    """
    if problem.dataset is None:
        raise MadocError("this learner learns from logged data: give it a dataset")
    if len(problem.dataset) < rows:
        raise MadocError(
            f"this learner needs at least as many rows as a batch has, {rows}, got {len(problem.dataset)} in "
            f"{problem.dataset.origin}; give it more data or a smaller batch"
        )
    if outcomes and not np.any(problem.dataset.transitions.reward):
        raise MadocError(
            f"this learner learns from logged rewards, and every reward in {problem.dataset.origin} is 0; "
            "use bc, or a learner that takes its rewards from the simulator"
        )
    if outcomes and problem.dataset.disturbance.shuffled == "next_observations":
        raise MadocError(
            f"this learner learns from what followed on each action, and the next observations in "
            f"{problem.dataset.origin} are not those of their rows; use bc, sac-bc or dr-bc"
        )
    return problem.dataset


def draw_rows(logged: dict[str, Array], key: PRNGKeyArray, *shape: int) -> dict[str, Array]:
    """Logged rows, drawn uniformly with replacement, with leading axes of this shape."""
    rows = jax.random.randint(key, shape, 0, len(logged["reward"]))
    return {name: column[rows] for name, column in logged.items()}


def require_reward(task: Task) -> None:
    """Refuse a robot that has no reward: nothing could be learnt for it.

    Raises:
        MadocError: It has none.
    """
    if not task.rewarded:
        raise MadocError(f"{task.name} has no reward, so no policy can be learnt for it; give its spec a reward:")


@runtime_checkable
class PolicyLearner(Method[PolicyProblem, State], Protocol[State]):
    """A method that learns a policy."""

    def policy(self, state: State) -> TanhGaussianPolicy:
        """The policy learnt so far; deterministic without a key."""
        ...
