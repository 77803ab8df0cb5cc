"""What is seen of logged and of simulated rows: moments of sets of windows."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from sklearn.covariance import ledoit_wolf

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.baselines.npe.emulator import Cosines, Emulator, moments
from madoc.calibration.sensing import rows_compared

PRIOR_PRECISION = 3.0
"""Of a value that is uniform in [-1, 1], whose variance is a third."""
_LEAST_VARIANCE = 1e-12
"""Added to variances of what may not vary."""

Points = Float[np.ndarray, "draws d"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sets:
    """Moments of sets of rows: their means, the slopes of these by a point, and how many rows they are of."""

    values: Float[np.ndarray, "*sets moments"]
    slopes: Float[np.ndarray, "*sets moments d"]
    rows: Float[np.ndarray, "*sets"]

    def joined(self, axis: int) -> "Sets":
        """The sets along an axis as one."""
        total = np.asarray(self.rows.sum(axis))
        share = self.rows / np.maximum(np.expand_dims(total, axis), 1e-9)
        return Sets((share[..., None] * self.values).sum(axis), (share[..., None, None] * self.slopes).sum(axis), total)


def errors_of(sets: Sets, points: Float[np.ndarray, "*sets d"]) -> Float[np.ndarray, "*sets moments"]:
    """What moments differ by from what the points that their rows were simulated under make of them, T - J u."""
    return sets.values - (sets.slopes @ points[..., None])[..., 0]


@dataclass(frozen=True)
class Reader:
    """How moments are read: as a log's whose rows have these slopes would be.

    It is the generalised method of moments (Hansen 1982) with the prior's precision, (JᵀWJ + 3)⁻¹ JᵀW. Rows of a small
    set may have slopes that tell little or much; with the log's, all draws are read alike.

    Attributes:
        slopes: J, the slopes of the log's moments by a point.
        bias: Mean of the moments at the true point.
        precision: W, the inverse of their covariance about it.
    """

    slopes: Float[np.ndarray, "moments d"]
    bias: Float[np.ndarray, " moments"]
    precision: Float[np.ndarray, "moments moments"]

    @classmethod
    def of(cls, slopes: Float[np.ndarray, "moments d"], errors: Float[np.ndarray, "draws moments"]) -> "Reader":
        """The reader of a log, given how moments err at known points; the covariance is Ledoit and Wolf's (2004)."""
        bias, scale = errors.mean(0), np.sqrt(errors.var(0) + _LEAST_VARIANCE)
        covariance = ledoit_wolf((errors - bias) / scale, assume_centered=True)[0]
        covariance = covariance + _LEAST_VARIANCE * np.eye(len(scale))
        return cls(slopes, bias, np.linalg.inv(covariance) / scale / scale[:, None])

    def statistic(self, values: Float[np.ndarray, "*sets moments"]) -> Float[np.ndarray, "*sets d"]:
        """The point that a log with these moments is read as."""
        weighted = self.slopes.T @ self.precision
        information = weighted @ self.slopes + PRIOR_PRECISION * np.eye(self.slopes.shape[1])
        return (values - self.bias) @ np.linalg.solve(information, weighted).T

    def misfit(self, values: Float[np.ndarray, "*sets moments"]) -> Float[np.ndarray, "*sets"]:
        """Squared Mahalanobis distance of moments from those at the point that they are read as (Hansen's J)."""
        off = values - self.bias - self.statistic(values) @ self.slopes.T
        return np.asarray(np.einsum("...i,ij,...j->...", off, self.precision, off))


def less_noisy(statistics: Points, points: Points, noise: Float[np.ndarray, "d d"], share: float) -> Points:
    """Statistics of small sets as those of a set with `share` of their sampling noise would be.

    A log has many more rows than one draw: what is left of its statistic's error is what the emulator does wrong. The
    error about a linear regression on the points is scaled until its covariance C is C - (1 - share) `noise`. Draws do
    not tell C any better than to one part in their number's square root, so no variance shrinks to less than that.
    """
    design = np.concatenate([np.ones((len(points), 1)), points], axis=1)
    fitted = design @ np.linalg.lstsq(design, statistics, rcond=None)[0]
    errors = statistics - fitted
    covariance = errors.T @ errors / max(1, len(errors) - design.shape[1]) + _LEAST_VARIANCE * np.eye(points.shape[1])
    root = np.linalg.cholesky(covariance)
    inverse = np.linalg.inv(root)
    parts, axes = np.linalg.eigh(inverse @ noise @ inverse.T)
    left = np.sqrt(np.clip(1.0 - (1.0 - share) * parts, 1.0 / np.sqrt(len(points)), 1.0))
    return fitted + errors @ inverse.T @ (axes * left) @ axes.T @ root.T


_BLOCK = 2000
"""Logged windows whose moments are in memory at a time."""


def unpaired(problem: CalibrationProblem) -> bool:
    """Whether it is not known which next observation belongs to which row."""
    return problem.dataset.disturbance.shuffled == "next_observations"


def set_moments(
    problem: CalibrationProblem,
    emulator: Emulator,
    features: Cosines,
    window: Float[np.ndarray, "*sets rows window"],
    following: Float[np.ndarray, "*sets rows observation"],
    counted: Bool[np.ndarray, "*sets rows"],
) -> Sets:
    """Moments of sets of rows, of the rows that are `counted`."""
    scaling, _ = problem.features.windows("standardised", rows_compared(problem))
    ratio = jnp.asarray(scaling.next_scale / scaling.scaling.pair_scale[: following.shape[-1]], jnp.float32)
    sets = counted.shape[:-1]
    windows, followings, weights = (
        jnp.asarray(part.reshape(-1, *part.shape[len(sets) :]), jnp.float32) for part in (window, following, counted)
    )
    marginals = (features, ratio) if unpaired(problem) else None
    means = moments(emulator, windows, followings, weights, marginals)
    return Sets(*(np.asarray(part, np.float64).reshape(*sets, *part.shape[1:]) for part in means))


def logged_moments(problem: CalibrationProblem, emulator: Emulator, features: Cosines) -> Sets:
    """Moments of the whole log. Where pairs are unknown, all of its rows still have all of its next observations."""
    window, following = map(np.asarray, problem.features.windows("standardised", rows_compared(problem))[1])
    count, block = len(window), min(_BLOCK, len(window))
    index = np.arange(count + -count % block).reshape(-1, block)
    rows = np.minimum(index, count - 1)
    return set_moments(problem, emulator, features, window[rows], following[rows], index < count).joined(0)


def by_halves(part: np.ndarray) -> np.ndarray:
    """(steps, draws, rows, ...) as (draws, 2, steps of half of the rows, ...); an odd row is left out."""
    steps, draws, rows = part.shape[:3]
    half = rows // 2
    return np.moveaxis(part, 0, 2)[:, : 2 * half].reshape(draws, 2, half * steps, *part.shape[3:])
