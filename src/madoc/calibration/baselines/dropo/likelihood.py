"""The equations of DROPO's objective: draws of parameters, and the likelihood of logged next states under them.

Tiboni et al. 2023, "DROPO: sim-to-real transfer with offline domain randomization" (arXiv 2201.08434).
"""

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

TRUNCATION = 2.0
"""Number of standard deviations at which the parameter distribution is truncated."""


def truncated_noise(key: PRNGKeyArray, draws: int, dimensions: int) -> Float[np.ndarray, "draws d"]:
    """Independent standard normal draws truncated at ±2."""
    return np.asarray(jax.random.truncated_normal(key, -TRUNCATION, TRUNCATION, (draws, dimensions)), np.float64)


def parameter_draws(
    mean: Float[np.ndarray, "candidates d"], std: Float[np.ndarray, "candidates d"], noise: Float[np.ndarray, "draws d"]
) -> Float[np.ndarray, "candidates draws d"]:
    """ξ = μ + σ ε, put on the wall where it leaves the box [-1, 1]."""
    return np.clip(mean[:, None] + std[:, None] * noise, -1.0, 1.0)


def residual_variance(
    noise: Float[np.ndarray, " values"], typical_change: Float[np.ndarray, " values"], epsilon: float
) -> Float[np.ndarray, " values"]:
    """ε + 2 σ², in squared typical changes: a residual has the noise of two readings, where it starts and ends.

    It is what a channel hands on of its own noise, which over one short step is about all; what channels hand on to
    each other is left out.
    """
    return epsilon + 2.0 * (noise / typical_change) ** 2


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


def shrunk(
    covariance: Float[np.ndarray, "candidates rows values values"], draws: Int[np.ndarray, "candidates rows"]
) -> Float[np.ndarray, "candidates rows values values"]:
    """(1 - ρ) S + ρ diag(S): of full rank wherever every value varies, with however few draws it was estimated.

    ρ is the oracle-approximating one, eq. (23), Chen et al. 2010 (arXiv 0907.4698), for the correlations, whose target
    is I: values differ in scale, and a common variance would drown the small ones.
    """
    values = covariance.shape[-1]
    scale = np.sqrt(np.einsum("crvv->crv", covariance))
    scale = np.where(scale > 0.0, scale, 1.0)
    squares = ((covariance / scale[..., None] / scale[..., None, :]) ** 2).sum((-1, -2))
    spread = (draws + 1.0 - 2.0 / values) * np.maximum(squares - values, 0.0)
    wanted = (1.0 - 2.0 / values) * squares + values**2
    share = np.minimum(1.0, wanted / np.where(spread > 0.0, spread, wanted))[..., None, None]
    return np.where(np.eye(values, dtype=bool), covariance, (1.0 - share) * covariance)


def negative_log_likelihood(
    mean: Float[np.ndarray, "candidates rows values"],
    covariance: Float[np.ndarray, "candidates rows values values"],
    variance: Float[np.ndarray, " values"],
) -> Float[np.ndarray, "candidates rows"]:
    """-log N(s'; mean, covariance + diag(variance)) of residuals, whose logged value is 0. NaN where the moments are.

    The authors' ε is the same for all values; here a noisy sensor has more.
    """
    values = mean.shape[-1]
    failed = np.isnan(mean).any(-1)
    whole = np.where(failed[..., None, None], np.eye(values), covariance + np.diag(variance))
    centre = np.where(failed[..., None], 0.0, mean)
    distance = (centre * np.linalg.solve(whole, centre[..., None])[..., 0]).sum(-1)
    negative = 0.5 * (values * np.log(2.0 * np.pi) + np.linalg.slogdet(whole)[1] + distance)
    return np.where(failed, np.nan, negative)


def entropy(std: Float[np.ndarray, "candidates d"]) -> Float[np.ndarray, " candidates"]:
    """Shannon entropy of N(μ, diag σ²), in nats: E-DROPO's bonus. Cutting it off changes it by a constant."""
    return 0.5 * np.log(2.0 * np.pi * np.e * std**2).sum(-1)
