"""Where the parameters of the systems come from that a policy is learnt in: fixed values, or a distribution."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.errors import MadocError
from madoc.parameters import ParameterSpace


@runtime_checkable
class ParameterDistribution(Protocol):
    """Parameters to draw systems from. A learner draws again every epoch, one system an environment."""

    @property
    def size(self) -> int:
        """Parameters of one system."""
        ...

    def draw(self, key: PRNGKeyArray, count: int) -> Float[np.ndarray, "count parameters"]:
        """Physical values of `count` systems, within the box."""
        ...


@dataclass(frozen=True)
class UniformParameters:
    """Domain randomization over the whole box (Tobin et al. 2017, arXiv 1703.06907): no calibration at all."""

    space: ParameterSpace

    @property
    def size(self) -> int:
        """Parameters of one system."""
        return len(self.space)

    def draw(self, key: PRNGKeyArray, count: int) -> Float[np.ndarray, "count parameters"]:
        """Physical values of `count` systems."""
        scaled = jax.random.uniform(key, (count, self.size), minval=-1.0, maxval=1.0)
        return self.space.to_physical(np.asarray(scaled))


@dataclass(frozen=True)
class NormalParameters:
    """A calibrated distribution: normal, each draw clipped to the box.

    Attributes:
        space: The box.
        mean: The estimate, physical units.
        covariance: Its joint spread, physical units; of a calibration that knows no more than the spread of each
            parameter, the diagonal of their squares.

    Raises:
        MadocError: Shapes disagree, or the covariance is not one.
    """

    space: ParameterSpace
    mean: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]

    def __post_init__(self) -> None:
        size = len(self.space)
        if np.shape(self.mean) != (size,) or np.shape(self.covariance) != (size, size):
            raise MadocError(
                f"expected a mean of {size} values and a covariance of {size} x {size}, "
                f"got shapes {np.shape(self.mean)} and {np.shape(self.covariance)}"
            )
        if not np.allclose(self.covariance, np.transpose(self.covariance)) or self._eigenvalues.min() < -1e-6:
            raise MadocError("expected a symmetric covariance without negative eigenvalues; is it a covariance?")

    @property
    def size(self) -> int:
        """Parameters of one system."""
        return len(self.space)

    def draw(self, key: PRNGKeyArray, count: int) -> Float[np.ndarray, "count parameters"]:
        """Physical values of `count` systems: mean + V sqrt(Λ) z of the scaled covariance V Λ Vᵀ, clipped."""
        values, vectors = np.linalg.eigh(self._scaled_covariance)
        # An eigenvector's sign is the library's choice, and must not decide what is drawn.
        vectors = vectors * np.where(vectors[np.abs(vectors).argmax(0), np.arange(self.size)] < 0, -1.0, 1.0)
        standard = np.asarray(jax.random.normal(key, (count, self.size)), dtype=np.float64)
        offsets = standard * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
        return np.clip(self.mean + offsets * self._width, self.space.low, self.space.high)

    @property
    def _width(self) -> np.ndarray:
        return self.space.high - self.space.low

    @property
    def _scaled_covariance(self) -> np.ndarray:
        """In units of the box: kilograms and m/s² are not compared."""
        return np.asarray(self.covariance, dtype=np.float64) / np.outer(self._width, self._width)

    @property
    def _eigenvalues(self) -> np.ndarray:
        return np.linalg.eigvalsh(self._scaled_covariance)
