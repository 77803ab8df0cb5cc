"""Robust losses of residuals: their values, slopes, curvatures and scales.

With z = (r / c)², a residual r costs c² / 2 · ρ(z); SciPy's `least_squares` has the same four. Its slope is
ψ(r) = ρ'(z) r, the slope of that is ρ'(z) + 2 z ρ''(z).
"""

from collections.abc import Callable
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

Loss = Literal["linear", "huber", "soft-l1", "cauchy"]

TUNING: dict[Loss, float] = {"linear": 1.0, "huber": 1.345, "soft-l1": 1.345, "cauchy": 2.385}
"""c in standard deviations: 95 % efficient under normal noise (Holland and Welsch 1977); soft-l1 as Huber's."""
_NORMAL_90 = 1.644854
"""90th percentile of the absolute value of normal noise, in standard deviations."""
_SHARE_OF_TAIL = 0.2
"""Smallest robust standard deviation relative to that by the 90th percentile, in [0, 1]."""
NORMAL_MAD = 1.4826
"""Standard deviation over median absolute deviation of normal noise."""
_SMALLEST_SCALE = 1e-12
"""Residual in typical changes of a channel; smaller ones are rounding errors."""
ALL_FAILED = 1e30
"""Cost where every simulation failed: large, but finite, as states of methods must be."""

Residuals = Float[np.ndarray, "*windows values"]


_FUNCTIONS: dict[Loss, tuple[Callable[[Residuals], Residuals], ...]] = {
    "linear": (lambda z: z, np.ones_like, np.ones_like),
    "huber": (
        lambda z: np.where(z <= 1.0, z, 2.0 * np.sqrt(np.maximum(z, 1.0)) - 1.0),
        lambda z: 1.0 / np.sqrt(np.maximum(z, 1.0)),
        lambda z: (z <= 1.0).astype(np.float64),
    ),
    "soft-l1": (
        lambda z: 2.0 * (np.sqrt(1.0 + z) - 1.0),
        lambda z: 1.0 / np.sqrt(1.0 + z),
        lambda z: (1.0 + z) ** -1.5,
    ),
    "cauchy": (np.log1p, lambda z: 1.0 / (1.0 + z), lambda z: (1.0 - z) / (1.0 + z) ** 2),
}
"""ρ(z), ρ'(z) and ρ'(z) + 2 z ρ''(z) of each loss."""


def loss_value(z: Residuals, loss: Loss) -> Residuals:
    """ρ(z)."""
    return _FUNCTIONS[loss][0](z)


def loss_slope(z: Residuals, loss: Loss) -> Residuals:
    """ρ'(z): the weight of a squared residual."""
    return _FUNCTIONS[loss][1](z)


def loss_curvature(z: Residuals, loss: Loss) -> Residuals:
    """ρ'(z) + 2 z ρ''(z): the derivative of ψ by the residual. It is negative in Cauchy's tails."""
    return _FUNCTIONS[loss][2](z)


def curvature_share(z: Residuals, loss: Loss) -> float:
    """Mean of ψ' over the mean of ρ': the curvature of the loss over that of the weighted squares, at least 0.1.

    It is one number for all residuals, as derivatives do not depend on their size (Huber 1981, section 7.6). Only where
    Cauchy's tails prevail, so that residuals are not noise, would it be smaller.
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
    """The standard deviation of normal noise with the same median of |residuals|, in typical changes of a stride.

    Where a robot rests and its sensors are coarse, most residuals are 0. It is therefore at least a fifth of the
    standard deviation by the 90th percentile, of which at most 1, a step's change, counts.
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
