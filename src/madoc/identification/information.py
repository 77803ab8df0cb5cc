"""Covariance, confidence intervals and identifiability of a least-squares estimate in [-1, 1]."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import stdtrit

from madoc.identification.linearisation import Linearisation
from madoc.identification.losses import Loss, loss_curvature, loss_slope

CONFIDENCE = 0.95
"""Level of confidence intervals, in (0, 1)."""
NORMAL_95 = 1.959963984540054
"""Half of a 95 % interval in standard errors of a normal estimate."""
OPEN = 0.5
"""Share in [0, 1] of its range that a parameter's 95 % interval covers; from it on the parameter counts as open."""
SETTLED = 0.1
"""Ratio in [0, 1] of a step to the standard error; a smaller step is not worth a simulation."""
BOX_VARIANCE = 1.0 / 3.0
"""Variance of a uniform distribution over [-1, 1]: that of a direction that the data does not identify."""
_BLIND = 1e-12
"""Curvature along a direction relative to the largest; a smaller one is an error of the finite differences."""
_CORRELATED = 0.95
"""Absolute correlation in [0, 1]; a pair of parameters with a larger one is named."""
_SHARE = 0.2
"""Component of a direction relative to its largest; parameters with a larger one are named."""


@dataclass(frozen=True)
class Uncertainty:
    """The uncertainty of an estimate in [-1, 1].

    Attributes:
        covariance: Covariance of the estimate; directions that the data cannot identify have the box's variance.
        correlation: Correlation by the curvature alone, as residuals of clean data are rounding errors.
        unidentified: Directions that the data cannot identify, one a row, each of length 1.
    """

    covariance: Float[np.ndarray, "d d"]
    correlation: Float[np.ndarray, "d d"]
    unidentified: Float[np.ndarray, "directions d"]


def bread(around: Linearisation, scale: float, loss: Loss) -> Float[np.ndarray, "d d"]:
    """Σ ψ' J Jᵀ, the curvature of the cost; Σ ρ' J Jᵀ where that is not positive definite, as in Cauchy's tails."""
    z = (around.residuals / scale) ** 2
    curved = _sum_of_products(around, loss_curvature(z, loss))
    return curved if np.linalg.eigvalsh(curved)[0] > 0 else _sum_of_products(around, loss_slope(z, loss))


def meat(around: Linearisation, scale: float, loss: Loss) -> Float[np.ndarray, "d d"]:
    """Σ g gᵀ over windows, g = Σ ψ J: the scatter of the windows' gradients, times n / (n - d) for n windows.

    Residuals of one window may depend on each other, those of different windows are assumed to be independent.
    """
    windows, _, count = around.jacobian.shape
    slope = loss_slope((around.residuals / scale) ** 2, loss) * around.residuals
    scores = np.einsum("wv,wvd->wd", slope, around.jacobian)
    return scores.T @ scores * windows / max(1, windows - count)


def jackknife_meat(around: Linearisation, share: float, bread: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """B C B with the jackknife covariance C of leaving out one window: (n - 1) / n Σ δ δᵀ, δ = (B - B_w)⁻¹ g_w.

    g_w is the gradient of the window's cost and B_w its part of the bread B, which is `share` times the sum of products
    of derivatives. A window of much weight draws the estimate towards itself, which `meat` does not show but leaving
    the window out does (Bell and McCaffrey 2002, the CR3 of MacKinnon and White 1985). It matters where windows are few
    and differ.
    """
    windows = len(around.jacobian)
    scores = np.einsum("wv,wvd->wd", around.residuals, around.jacobian)
    parts = share * np.einsum("wvd,wve->wde", around.jacobian, around.jacobian)
    others = bread - parts
    alone = np.linalg.eigvalsh(others)[:, 0] <= _BLIND * np.trace(bread)
    others[alone] += parts[alone]  # without it the problem is singular: it counts as in `meat`
    influence = np.einsum("wde,we->wd", np.linalg.pinv(others, rcond=_BLIND, hermitian=True), scores) @ bread
    return influence.T @ influence * (windows - 1) / max(1, windows)


def least_share(part: Linearisation, whole: Linearisation) -> float:
    """The smallest eigenvalue of B_part v = λ B_whole v: the share of the information that a part of the windows holds.

    It is that of the worst direction, among those that all windows together identify.
    """
    values, vectors = np.linalg.eigh(_sum_of_products(whole, np.ones_like(whole.residuals)))
    identified = values > _BLIND * max(float(values[-1]), np.finfo(float).tiny)
    if not identified.any():
        return 1.0
    basis = vectors[:, identified] / np.sqrt(values[identified])
    return float(np.linalg.eigvalsh(basis.T @ _sum_of_products(part, np.ones_like(part.residuals)) @ basis)[0])


def at_least_noise(
    meat: Float[np.ndarray, "d d"], bread: Float[np.ndarray, "d d"], ratio: float
) -> Float[np.ndarray, "d d"]:
    """The meat B C B of a covariance C, enlarged where C's variances are smaller than those of independent equal noise.

    The gradients of few windows may scatter too little by chance. Noise of the same variance in all windows has the
    covariance `ratio` B⁻¹, with the ratio of the variance of a reading's gradient to its mean curvature.
    """
    inverse = np.linalg.pinv(bread, rcond=_BLIND, hermitian=True)
    covariance = inverse @ meat @ inverse
    by_windows, by_noise = np.diag(covariance), ratio * np.diag(inverse)
    told = by_noise > 0.0
    alone = told & (by_windows <= _BLIND * by_noise)  # as for what a single window tells, which has no scatter
    if (alone == told).all():
        return ratio * bread
    wider = np.where(alone, 0.0, np.sqrt(np.maximum(1.0, by_noise / np.where(by_windows > 0.0, by_windows, 1.0))))
    covariance = wider[:, None] * covariance * wider + np.diag(np.where(alone, by_noise, 0.0))
    return bread @ covariance @ bread


def sandwich(bread: Float[np.ndarray, "d d"], meat: Float[np.ndarray, "d d"]) -> Uncertainty:
    """The covariance bread⁻¹ meat bread⁻¹ (Huber 1967) in identified directions, the box's variance in others.

    It is valid for robust losses, for channels of unequal noise, and for noise that is not normal.
    """
    values, vectors = np.linalg.eigh(bread)
    identified: Bool[np.ndarray, " d"] = values > _BLIND * max(float(values[-1]), np.finfo(float).tiny)
    inverse = (vectors[:, identified] / values[identified]) @ vectors[:, identified].T
    scatter, along = np.linalg.eigh(meat)  # below rounding it is not known, and could come out negative
    root = inverse @ along * np.sqrt(np.maximum(scatter, np.finfo(float).eps * max(float(scatter[-1]), 0.0)))
    covariance = root @ root.T
    identified &= np.einsum("id,ij,jd->d", vectors, covariance, vectors) < BOX_VARIANCE
    kept, lost = vectors[:, identified] @ (vectors[:, identified].T @ root), vectors[:, ~identified]
    deviation = np.sqrt(np.maximum(np.diag(inverse), np.finfo(float).tiny))
    return Uncertainty(
        covariance=kept @ kept.T + BOX_VARIANCE * lost @ lost.T,
        correlation=inverse / deviation[:, None] / deviation,
        unidentified=lost.T,
    )


def half_width(covariance: Float[np.ndarray, "d d"], windows: int) -> Float[np.ndarray, " d"]:
    """Half of the 95 % interval: the quantile of Student's t times the standard error."""
    return quantile(windows, len(covariance)) * np.sqrt(np.diag(covariance))


def quantile(windows: int, parameters: int) -> float:
    """Standard errors in half of a 95 % interval: of Student's t with windows - parameters degrees of freedom."""
    return float(stdtrit(max(1, windows - parameters), 0.5 + CONFIDENCE / 2.0))


def identifiability(uncertainty: Uncertainty, names: tuple[str, ...]) -> tuple[str, ...]:
    """One sentence on parameters that the data cannot identify, and one on pairs of highly correlated estimates."""
    alone: dict[str, None] = {}
    together: dict[str, None] = {}
    for direction in np.abs(uncertainty.unidentified):
        involved = [name for name, part in zip(names, direction, strict=True) if part > _SHARE * direction.max()]
        (alone if len(involved) == 1 else together).update(dict.fromkeys(involved))
    sentences: list[str] = []
    if together:
        sentences.append(
            f"the data does not identify {', '.join({**together, **alone})} together: they can change jointly without "
            "changing what is seen; leave one of them out, or keep to the combinations that the data tells"
        )
    elif alone:
        several, whose = ("them", "their") if len(alone) > 1 else ("it", "its")
        sentences.append(f"the data does not identify {', '.join(alone)}; leave {several} out or narrow {whose} range")
    pairs = [
        pair
        for pair in correlated_pairs(uncertainty.correlation, names)
        if not {*together, *alone}.issuperset(pair[:2])
    ]
    if pairs:
        listed = ", ".join(f"{first} and {second} ({value:+.2f})" for first, second, value in pairs)
        sentences.append(f"the data can hardly tell apart (correlation of the estimates): {listed}")
    return tuple(sentences)


def correlated_pairs(correlation: Float[np.ndarray, "d d"], names: tuple[str, ...]) -> list[tuple[str, str, float]]:
    """Pairs of parameters whose estimates can hardly be told apart, strongest correlation first."""
    rows, columns = np.triu_indices(len(names), 1)
    strong = [(names[i], names[j], float(correlation[i, j])) for i, j in zip(rows, columns, strict=True)]
    return sorted((pair for pair in strong if abs(pair[2]) > _CORRELATED), key=lambda pair: -abs(pair[2]))


def _sum_of_products(around: Linearisation, weights: Float[np.ndarray, "windows values"]) -> Float[np.ndarray, "d d"]:
    count = around.jacobian.shape[-1]
    flat = around.jacobian.reshape(-1, count)
    return flat.T @ (weights.reshape(-1, 1) * flat)
