"""Distances between clouds of rows whose order and pairing are unknown: means of random cosine features.

The distance between two means is the maximum mean discrepancy (Gretton et al. 2012) under Gaussian kernels, by random
Fourier features (Rahimi and Recht 2007).
"""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

WIDTHS = (0.5, 1.0, 2.0)
"""Of the kernels, in units of √dimensions: half, once and twice the typical distance of standardised rows."""
_ROWS_AT_ONCE = 10_000
RIDGE = 1e-3
"""Of the mean variance of a feature, added to all of them."""
_SMALLEST_VARIANCE = 1e-12
_SLOPE_RIDGE = 1e-6
"""Added to the mean squares of covariates, which are cosines: those that hardly vary explain nothing."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CosineFeatures:
    """φ(x) = cos(x W + b), with rows standardised first by whoever calls it."""

    frequencies: Float[np.ndarray, "dimensions features"]
    phases: Float[np.ndarray, " features"]

    def __call__(self, rows: Float[np.ndarray, "*rows dimensions"]) -> Float[np.ndarray, "*rows features"]:
        """Features of rows."""
        return np.cos(rows @ self.frequencies + self.phases)

    def mean(self, rows: Float[np.ndarray, "rows dimensions"]) -> Float[np.ndarray, " features"]:
        """Mean feature of many rows, a part at a time."""
        parts = np.array_split(rows, max(1, len(rows) // _ROWS_AT_ONCE))
        return np.sum([self(part).sum(0) for part in parts], axis=0) / len(rows)


def cosine_features(key: PRNGKeyArray, dimensions: int, count: int) -> CosineFeatures:
    """Random frequencies of Gaussian kernels of each width in turn, uniform phases."""
    of_frequencies, of_phases = jax.random.split(key)
    frequencies = np.asarray(jax.random.normal(of_frequencies, (dimensions, count)), np.float64)
    widths = np.sqrt(dimensions) * np.resize(WIDTHS, count)
    phases = np.asarray(jax.random.uniform(of_phases, (count,), maxval=2.0 * np.pi), np.float64)
    return CosineFeatures(frequencies / widths, phases)


def discrepancies(
    features: Float[np.ndarray, "clouds rows features"], wanted: Float[np.ndarray, " features"]
) -> Float[np.ndarray, " clouds"]:
    """Squared distance of each cloud's mean feature m from the wanted w: n (m - w)ᵀ S⁻¹ (m - w), in standard errors.

    S is the covariance of rows about their cloud's mean, pooled over clouds, with a small ridge: features that hardly
    vary from row to row weigh most. Rows that failed (NaN) are left out; NaN for a cloud in which all did.
    """
    valid = np.isfinite(features).all(-1)
    count = valid.sum(1)
    mean = np.where(valid[..., None], features, 0.0).sum(1) / np.where(count > 0, count, np.nan)[:, None]
    off = (features - mean[:, None])[valid]
    covariance = off.T @ off / max(1, len(off))
    ridge = RIDGE * np.trace(covariance) / len(covariance) + _SMALLEST_VARIANCE
    gap = mean - wanted
    solved = np.linalg.solve(covariance + ridge * np.eye(len(covariance)), np.nan_to_num(gap).T).T
    return count * (gap * solved).sum(-1)


def adjusted(
    features: Float[np.ndarray, "clouds rows features"], covariates: Float[np.ndarray, "rows covariates"]
) -> Float[np.ndarray, "clouds rows features"]:
    """Features of drawn rows, less the part by which the draw differs from the whole log.

    Covariates are known of all logged rows and have mean 0 there; their mean in a draw, times the slopes of features
    on them, is chance. This is the regression estimator of survey sampling (Särndal et al. 1992, section 6.4). Slopes
    are each cloud's own, from rows that failed in none.
    """
    whole = np.isfinite(features).all((0, 2))
    if not whole.any():
        return features
    design = np.concatenate([np.ones((whole.sum(), 1)), covariates[whole]], axis=1)
    squares = design.T @ design / len(design)
    slopes = np.linalg.solve(squares + _SLOPE_RIDGE * np.eye(len(squares)), design.T @ features[:, whole] / len(design))
    return features - covariates @ slopes[:, 1:]
