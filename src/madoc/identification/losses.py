"""Robust losses of residuals, and how one epoch's residuals become the terms of a least-squares problem.

With z = (r / c)², a residual r costs c² / 2 · ρ(z); SciPy's `least_squares` has the same four. Its slope is
ψ(r) = ρ'(z) r, the slope of that is ρ'(z) + 2 z ρ''(z).
"""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

Loss = Literal["linear", "huber", "soft-l1", "cauchy"]

TUNING: dict[Loss, float] = {"linear": 1.0, "huber": 1.345, "soft-l1": 1.345, "cauchy": 2.385}
"""c in standard deviations: 95 % efficient under normal noise (Holland and Welsch 1977); soft-l1 as Huber's."""
_NORMAL_90 = 1.644854
"""90th percentile of the absolute value of normal noise, in standard deviations."""
_SHARE_OF_TAIL = 0.2
"""Least robust deviation, from 0 to 1, relative to that of the 90th percentile."""
NORMAL_MAD = 1.4826
"""Standard deviation over median absolute deviation of normal noise, to four places: 1.4826."""
_SMALLEST_SCALE = 1e-12
"""Residuals are in units of a channel's typical change; below this they are rounding."""
ALL_FAILED = 1e30
"""Cost where no simulation succeeded; a state holds no infinity."""

Residuals = Float[np.ndarray, "*windows values"]


def loss_value(z: Residuals, loss: Loss) -> Residuals:
    """ρ(z): z; z up to 1 and 2√z - 1 beyond; 2(√(1 + z) - 1); ln(1 + z)."""
    if loss == "linear":
        return z
    if loss == "huber":
        return np.where(z <= 1.0, z, 2.0 * np.sqrt(np.maximum(z, 1.0)) - 1.0)
    if loss == "soft-l1":
        return 2.0 * (np.sqrt(1.0 + z) - 1.0)
    return np.log1p(z)


def loss_slope(z: Residuals, loss: Loss) -> Residuals:
    """ρ'(z): the weight of a squared residual."""
    if loss == "linear":
        return np.ones_like(z)
    if loss == "huber":
        return 1.0 / np.sqrt(np.maximum(z, 1.0))
    if loss == "soft-l1":
        return 1.0 / np.sqrt(1.0 + z)
    return 1.0 / (1.0 + z)


def loss_curvature(z: Residuals, loss: Loss) -> Residuals:
    """ρ'(z) + 2 z ρ''(z): how fast ψ grows with the residual. Negative for Cauchy's far tails."""
    if loss == "linear":
        return np.ones_like(z)
    if loss == "huber":
        return (z <= 1.0).astype(np.float64)
    if loss == "soft-l1":
        return (1.0 + z) ** -1.5
    return (1.0 - z) / (1.0 + z) ** 2


def curvature_share(z: Residuals, loss: Loss) -> float:
    """Mean of ψ' over the mean of ρ': the curvature of the loss over that of the weighted squares.

    One number for all residuals, as their slopes do not depend on how large they are (Huber 1981, section 7.6). Not
    below a tenth: past that Cauchy's tails prevail, and residuals are no longer noise.
    """
    if loss == "linear" or not z.size:
        return 1.0
    return max(0.1, float(loss_curvature(z, loss).mean() / loss_slope(z, loss).mean()))


def scale_of(residuals: Residuals, loss: Loss) -> float:
    """c: the tuning constant times the robust standard deviation of the residuals; 1 for `linear`."""
    if loss == "linear" or not residuals.size:
        return 1.0
    return TUNING[loss] * max(robust_deviation(np.abs(residuals)), _SMALLEST_SCALE)


def robust_deviation(size: Float[np.ndarray, "*values"]) -> float:
    """The standard deviation of normal noise with this median of |residuals|, in typical changes of a step.

    Where a robot rests and its sensors are coarse, most residuals are 0. So it is not below a fifth of what the 90th
    percentile makes it, as far as that is less than a step's change and so may be noise.
    """
    tail = min(float(np.percentile(size, 90)), 1.0)
    return max(NORMAL_MAD * float(np.median(size)), _SHARE_OF_TAIL * tail / _NORMAL_90)


def mean_cost(residuals: Float[np.ndarray, "windows values"], scale: float, loss: Loss) -> float:
    """Mean of c² ρ(z) over values; a window that failed (NaN) counts as the worst that did not, and at least as 1."""
    failed: Bool[np.ndarray, " windows"] = ~np.isfinite(residuals).all(-1)
    if failed.all():
        return ALL_FAILED
    cost = scale**2 * loss_value((residuals[~failed] / scale) ** 2, loss).mean(-1)
    worst = max(1.0, float(cost.max()))
    return float((cost.sum() + worst * failed.sum()) / len(residuals))
