"""The equations of DROPO's objective: draws of parameters, and the likelihood of logged next states under them.

Tiboni et al. 2023, "DROPO: sim-to-real transfer with offline domain randomization" (arXiv 2201.08434).
"""

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

TRUNCATION = 2.0
"""Number of standard deviations at which the parameter distribution is truncated."""


def truncated_noise(key: PRNGKeyArray, pairs: int, dimensions: int) -> Float[np.ndarray, "draws d"]:
    """Standard normal draws truncated at ±2, in antithetic pairs: the second half mirrors the first."""
    half = np.asarray(jax.random.truncated_normal(key, -TRUNCATION, TRUNCATION, (pairs, dimensions)), np.float64)
    return np.concatenate([half, -half])


def parameter_draws(
    mean: Float[np.ndarray, "candidates d"], std: Float[np.ndarray, "candidates d"], noise: Float[np.ndarray, "draws d"]
) -> Float[np.ndarray, "candidates draws d"]:
    """ξ = μ + σ ε, put on the wall where it leaves the box [-1, 1]."""
    return np.clip(mean[:, None] + std[:, None] * noise, -1.0, 1.0)


def moments(
    residuals: Float[np.ndarray, "candidates draws rows values"],
) -> tuple[Float[np.ndarray, "candidates rows values"], Float[np.ndarray, "candidates rows values values"]]:
    """Mean and covariance over the draws whose simulation did not fail (NaN), for every row; NaN for fewer than two."""
    valid = np.isfinite(residuals).all(-1, keepdims=True)
    count = valid.sum(1)
    enough = np.where(count > 1, count, np.nan)
    mean = np.where(valid, residuals, 0.0).sum(1) / enough
    off = np.where(valid, residuals - mean[:, None], 0.0)
    covariance = np.einsum("csrv,csrw->crvw", off, off) / (enough - 1.0)[..., None]
    return mean, covariance


def negative_log_likelihood(
    mean: Float[np.ndarray, "candidates rows values"],
    covariance: Float[np.ndarray, "candidates rows values values"],
    epsilon: float,
) -> Float[np.ndarray, "candidates rows"]:
    """-log N(s'; mean, covariance + ε I) of residuals, whose logged value is 0. NaN where the moments are."""
    values = mean.shape[-1]
    failed = np.isnan(mean).any(-1)
    eye = np.eye(values)
    whole = np.where(failed[..., None, None], eye, covariance + epsilon * eye)
    centre = np.where(failed[..., None], 0.0, mean)
    distance = (centre * np.linalg.solve(whole, centre[..., None])[..., 0]).sum(-1)
    negative = 0.5 * (values * np.log(2.0 * np.pi) + np.linalg.slogdet(whole)[1] + distance)
    return np.where(failed, np.nan, negative)


def entropy(std: Float[np.ndarray, "candidates d"]) -> Float[np.ndarray, " candidates"]:
    """Shannon entropy of N(μ, diag σ²), in nats: E-DROPO's bonus. Cutting it off changes it by a constant."""
    return 0.5 * np.log(2.0 * np.pi * np.e * std**2).sum(-1)
