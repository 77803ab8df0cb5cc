"""Distances between clouds of rows whose order and pairing are unknown: means of random cosine features.

The distance between two means is a kernel Hotelling statistic (Harchaoui, Bach and Moulines 2008): that of Mahalanobis,
with a ridge, of the means of random Fourier features of Gaussian kernels (Rahimi and Recht 2007).
"""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

WIDTHS = (0.5, 1.0, 2.0)
"""Widths of the kernels, in units of √dimensions, which is about the typical distance of standardised rows."""
_ROWS_AT_ONCE = 10_000
"""Largest number of rows whose features are in memory at a time."""
RIDGE = 1e-3
"""Ridge of the covariance of features, as a share of their mean variance."""
_SMALLEST_VARIANCE = 1e-12
"""Smallest ridge of the covariance of features, for features that do not vary."""
_SLOPE_RIDGE = 1e-6
"""Ridge of the mean squares of covariates, which are cosines: those that hardly vary then explain nothing."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CosineFeatures:
    """φ(x) = cos(x W + b) of standardised rows x."""

    frequencies: Float[np.ndarray, "dimensions features"]
    phases: Float[np.ndarray, " features"]

    def __call__(self, rows: Float[np.ndarray, "*rows dimensions"]) -> Float[np.ndarray, "*rows features"]:
        """Features of rows."""
        return np.cos(rows @ self.frequencies + self.phases)

    def mean(self, rows: Float[np.ndarray, "rows dimensions"]) -> Float[np.ndarray, " features"]:
        """Mean features of many rows."""
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
    """Squared Mahalanobis distance n (m - w)ᵀ S⁻¹ (m - w) of the mean m of each cloud of n rows from the wanted w.

    S is the covariance of rows about the mean of their cloud, pooled over clouds, with a small ridge. Rows that failed
    (NaN) are left out of the mean but counted in n, so that no cloud comes nearer by failing; the distance of a cloud
    in which all rows failed is NaN.
    """
    valid = np.isfinite(features).all(-1)
    count = valid.sum(1)
    mean = np.where(valid[..., None], features, 0.0).sum(1) / np.where(count > 0, count, np.nan)[:, None]
    off = (features - mean[:, None])[valid]
    covariance = off.T @ off / max(1, len(off))
    ridge = RIDGE * np.trace(covariance) / len(covariance) + _SMALLEST_VARIANCE
    gap = mean - wanted
    solved = np.linalg.solve(covariance + ridge * np.eye(len(covariance)), np.nan_to_num(gap).T).T
    return np.where(count > 0, features.shape[1], np.nan) * (gap * solved).sum(-1)


def adjusted(
    features: Float[np.ndarray, "clouds rows features"], covariates: Float[np.ndarray, "rows covariates"]
) -> Float[np.ndarray, "clouds rows features"]:
    """Features of drawn rows, corrected for the chance difference between the draw and the whole log.

    The mean of the covariates over the whole log is 0, so that their mean in a draw, times the slopes of features on
    them, is chance. This is the regression estimator of survey sampling (Särndal et al. 1992, section 6.4). Each cloud
    has its own slopes, from the rows that failed in no cloud.
    """
    whole = np.isfinite(features).all((0, 2))
    if not whole.any():
        return features
    design = np.concatenate([np.ones((whole.sum(), 1)), covariates[whole]], axis=1)
    squares = design.T @ design / len(design)
    slopes = np.linalg.solve(squares + _SLOPE_RIDGE * np.eye(len(squares)), design.T @ features[:, whole] / len(design))
    return features - covariates @ slopes[:, 1:]
