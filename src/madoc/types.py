"""What every room exchanges: transitions, policies, metrics."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal, Protocol, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

Method = TypeVar("Method", covariant=True)

Unit = Literal["control steps", "updates"]
"""What a budget counts: simulated control steps, or gradient updates where a method does not simulate."""

Metrics = dict[str, float]
"""Scalars worth looking at, by name. Never needed by the next step."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Transitions:
    """Rows of (s, a, r, s'), NumPy or JAX, with any leading axes.

    `terminated` ends the task (a fall); `truncated` only ends the record (a time limit).
    """

    observation: Float[Array | np.ndarray, "*rows observation"]
    action: Float[Array | np.ndarray, "*rows action"]
    reward: Float[Array | np.ndarray, "*rows"]
    next_observation: Float[Array | np.ndarray, "*rows observation"]
    terminated: Bool[Array | np.ndarray, "*rows"]
    truncated: Bool[Array | np.ndarray, "*rows"]

    def __len__(self) -> int:
        return len(self.reward)

    def take(self, rows: np.ndarray) -> "Transitions":
        """The given rows (indices or mask over the first axis)."""
        return jax.tree.map(lambda column: column[rows], self)


class Policy(Protocol):
    """Acts. With a key it samples, without one it returns its deterministic action."""

    def __call__(
        self, observation: Float[Array, "*rows observation"], key: PRNGKeyArray | None = None
    ) -> Float[Array, "*rows action"]:
        """Actions in [-1, 1] for a batch of observations."""
        ...


@dataclass(frozen=True)
class MethodEntry(Generic[Method]):
    """A line of `madoc methods`: `make` takes the method's hyperparameters as keywords, `unit` is its budget's."""

    make: Callable[..., Method]
    summary: str
    paper: str
    year: int
    unit: Unit = "control steps"
