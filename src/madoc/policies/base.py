"""The problem that a policy learner is given, distributions of systems to learn over, and the interface of learners."""

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
from madoc.learning import replay
from madoc.learning.features import Features
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.parameters import ParameterDistribution, ParameterSpace
from madoc.simulation.base import Simulator
from madoc.tasks.base import Task
from madoc.types import Method, State


@dataclass(frozen=True)
class PolicyProblem:
    """The simulated systems to learn a policy in, and logged transitions for learners that use them.

    The data's true parameters, if it has any, are dropped here, so that no method can read them.

    Attributes:
        simulator: The source domain.
        parameters: Physical values of one system, by name or as a vector (d,), or of several, one in each row; or a
            distribution to draw systems from.
        dataset: Logged transitions, or None.

    Raises:
        MadocError: The parameters or the data belong to another robot.
    """

    simulator: Simulator
    parameters: Float[np.ndarray, "*systems parameters"] | Mapping[str, float] | ParameterDistribution
    dataset: Dataset | None = None

    def __post_init__(self) -> None:
        task = self.simulator.task
        space = self.simulator.parameters
        if isinstance(self.parameters, ParameterDistribution):
            space.vector(self.parameters.draw(jax.random.key(0), 1))
        else:
            object.__setattr__(self, "parameters", np.atleast_2d(space.vector(self.parameters)))
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
        """The columns of the dataset that learners use, on the device, float32, by name as in a replay buffer."""
        rows = require_data(self, rows=0, outcomes=False).transitions
        columns = ("observation", "action", "reward", "next_observation", "terminated")
        return {name: jnp.asarray(getattr(rows, name), jnp.float32) for name in columns}

    @cached_property
    def features(self) -> Features:
        """The standardisation of the data's (s, a) and s' for networks."""
        return Features.of(require_data(self, rows=0, outcomes=False).transitions)

    def systems(self, key: PRNGKeyArray, count: int) -> Float[np.ndarray, "systems parameters"]:
        """Physical values of the systems to act in next: the fixed ones, or `count` new draws."""
        if isinstance(self.parameters, ParameterDistribution):
            return self.parameters.draw(key, count)
        return self.simulator.parameters.vector(self.parameters)


def require_data(problem: PolicyProblem, *, rows: int, outcomes: bool = True) -> Dataset:
    """The dataset, unless a learner could not use it.

    Raises:
        MadocError: There is none, or it has fewer than `rows` rows. Or the learner uses the `outcomes` r and s' of
            actions, and all rewards are 0 or the next observations are shuffled.
    """
    dataset = problem.dataset
    if dataset is None:
        raise MadocError("this learner learns from logged data: give it a dataset")
    if len(dataset) < rows:
        raise MadocError(
            f"this learner needs at least as many rows as a batch has, {rows}, got {len(dataset)} in "
            f"{dataset.origin}; give it more data or a smaller batch"
        )
    if outcomes and not np.any(dataset.transitions.reward):
        raise MadocError(
            f"this learner learns from logged rewards, and every reward in {dataset.origin} is 0; "
            "use bc, or a learner that takes its rewards from the simulator"
        )
    if outcomes and dataset.disturbance.shuffled == "next_observations":
        raise MadocError(
            f"this learner learns from the outcomes of actions, and the next observations in {dataset.origin} are "
            "shuffled; use bc, sac-bc or dr-bc"
        )
    return dataset


def draw_rows(logged: dict[str, Array], key: PRNGKeyArray, *shape: int) -> dict[str, Array]:
    """Logged rows, drawn uniformly with replacement, with leading axes of this shape."""
    return replay.take(logged, jax.random.randint(key, shape, 0, len(logged["reward"])))


def require_reward(task: Task) -> None:
    """Raise MadocError for a robot without a reward, for which no policy can be learnt."""
    if not task.rewarded:
        raise MadocError(f"{task.name} has no reward, so no policy can be learnt for it; give its spec a reward:")


@runtime_checkable
class PolicyLearner(Method[PolicyProblem, State], Protocol[State]):
    """A method that learns a policy."""

    def policy(self, state: State) -> TanhGaussianPolicy:
        """The policy learnt so far; deterministic without a key."""


@dataclass(frozen=True)
class UniformParameters:
    """The uniform distribution over all ranges, which needs no calibration (Tobin et al. 2017, arXiv 1703.06907)."""

    space: ParameterSpace

    def draw(self, key: PRNGKeyArray, count: int) -> Float[np.ndarray, "count parameters"]:
        """Physical values of `count` systems."""
        scaled = jax.random.uniform(key, (count, len(self.space)), minval=-1.0, maxval=1.0)
        return self.space.to_physical(np.asarray(scaled))


@dataclass(frozen=True)
class NormalParameters:
    """A normal distribution, as of a calibrated estimate, with every draw clipped to the ranges of `space`.

    `mean` and `covariance` are in physical units. A `share` of the systems is drawn, the others are the mean.

    Raises:
        MadocError: The shapes disagree, the share is not in [0, 1], or the covariance is not symmetric or has a
            negative eigenvalue.
    """

    space: ParameterSpace
    mean: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "rows columns"]
    share: float = 1.0

    def __post_init__(self) -> None:
        size = len(self.space)
        if np.shape(self.mean) != (size,) or np.shape(self.covariance) != (size, size):
            raise MadocError(
                f"expected a mean of {size} values and a covariance of {size} x {size}, "
                f"got shapes {np.shape(self.mean)} and {np.shape(self.covariance)}"
            )
        if not 0.0 <= self.share <= 1.0:
            raise MadocError(f"expected a share of systems to draw between 0 and 1, got {self.share:g}")
        symmetric = np.allclose(self.covariance, np.transpose(self.covariance))
        if not symmetric or np.linalg.eigvalsh(self._scaled_covariance).min() < -1e-6:
            raise MadocError("expected a symmetric covariance without negative eigenvalues; is it a covariance?")

    def draw(self, key: PRNGKeyArray, count: int) -> Float[np.ndarray, "count parameters"]:
        """Physical values of `count` systems: mean + V sqrt(Λ) z of the scaled covariance V Λ Vᵀ, clipped.

        Those that are not drawn but the mean come first.
        """
        values, vectors = np.linalg.eigh(self._scaled_covariance)
        # An eigenvector's sign is the library's choice, and must not decide what is drawn.
        vectors = vectors * np.where(vectors[np.abs(vectors).argmax(0), np.arange(len(self.space))] < 0, -1.0, 1.0)
        standard = np.asarray(jax.random.normal(key, (count, len(self.space))), dtype=np.float64)
        offsets = standard * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
        offsets[: count - round(self.share * count)] = 0.0
        return np.clip(self.mean + offsets * self._width, self.space.low, self.space.high)

    @property
    def _width(self) -> np.ndarray:
        return self.space.high - self.space.low

    @property
    def _scaled_covariance(self) -> np.ndarray:
        """The covariance with every parameter in units of its range, so that kilograms are not compared with m/s²."""
        return np.asarray(self.covariance, dtype=np.float64) / np.outer(self._width, self._width)
