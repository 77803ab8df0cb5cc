"""Distributions of parameters that a policy can be learnt over."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.errors import MadocError
from madoc.parameters import ParameterSpace


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
