"""Statistics of residuals that a search decides by: which windows are outliers, and whether only noise is left."""

import numpy as np
from jaxtyping import Float, Int

from madoc.calibration.base import CalibrationProblem
from madoc.identification.losses import NORMAL_MAD
from madoc.identification.noise import OUTLIER
from madoc.identification.replay import window_residuals
from madoc.identification.windows import consecutive_rows, windows_at

_LARGEST = 3.0
"""Standard deviations of the noise at which residuals are clipped before they are correlated."""
_SMALLEST = 1e-12
"""In units of a channel's typical change; below this it is rounding."""

Residuals = Float[np.ndarray, "pairs channels"]


def outlier_limits(
    values: Float[np.ndarray, "*rows windows"], activity: Float[np.ndarray, " windows"]
) -> tuple[Float[np.ndarray, "*rows 1"], Float[np.ndarray, "*rows 1"]]:
    """The median of windows' values, and how far from it a window is an outlier: `OUTLIER` robust deviations.

    Both are weighted by how much happens in a window: those in which nothing moves are all alike and tell little.
    """
    weights = np.broadcast_to(activity + np.finfo(float).tiny, values.shape)

    def medians(part: np.ndarray) -> np.ndarray:
        each = [
            np.quantile(row, 0.5, weights=own, method="inverted_cdf") for row, own in zip(part, weights, strict=True)
        ]
        return np.array(each)[:, None]

    rows = values.reshape(-1, values.shape[-1])
    weights = weights.reshape(rows.shape)
    middle = medians(rows)
    reach = OUTLIER * NORMAL_MAD * medians(np.abs(rows - middle))
    shape = (*values.shape[:-1], 1)
    return middle.reshape(shape), reach.reshape(shape)


def clipped_change(
    before: Float[np.ndarray, " windows"],
    after: Float[np.ndarray, "trials windows"],
    activity: Float[np.ndarray, " windows"],
    *,
    least: float,
    failed: float,
) -> Float[np.ndarray, "trials windows"]:
    """Change of the windows' costs, outliers that become worse clipped to the largest change that is none.

    A window that a step takes across a contact becomes much worse until its initial state has followed, in later
    epochs; it alone does not forbid a step that helps the others. One whose simulation fails does.

    Args:
        before: Cost of each window.
        after: The same after each of the steps tried.
        activity: How much happens in each window.
        least: A change up to this is never clipped.
        failed: Cost of a window whose simulation failed.
    """
    change = after - before
    middle, reach = outlier_limits(change, activity)
    return np.where(after < failed, np.minimum(change, np.maximum(middle + reach, least)), change)


def noise_ratio(
    residuals: Float[np.ndarray, "windows values"],
    weights: Float[np.ndarray, "windows values"],
    share: float,
    freedom: float,
) -> float:
    """Variance of ψ, the gradient of a reading's loss, over its mean curvature ψ'; 1 for squares of deviations."""
    pull = ((weights * residuals) ** 2).sum() / max(1.0, freedom)
    curvature = share * weights.sum() / max(1, weights.size)
    return float(pull / max(curvature, _SMALLEST))


def autocorrelation(residuals: Float[np.ndarray, "windows readings channels"]) -> float:
    """Correlation of a reading's residual with the next one's, of the channel that has most of it.

    Noise has none, model errors have. Residuals are in standard deviations of the noise and clipped at three of them;
    a channel with smaller residuals than its noise counts as uncorrelated.
    """
    clipped = np.clip(residuals, -_LARGEST, _LARGEST)
    power = np.maximum((clipped**2).sum((0, 1)), clipped[..., 0].size)
    return float(((clipped[:, 1:] * clipped[:, :-1]).sum((0, 1)) / power).max())


def alternation(before: Residuals, after: Residuals) -> float:
    """Minus the correlation of one-step residuals with the next row's, the mean over the half of channels with most.

    Of noise e alone a residual is about e' - e, as the reading it starts at carries noise as well as the one it ends
    at: the next one is e'' - e', and they correlate by -1/2. A model error has the same sign in the next row. Contacts
    make of noise something else in some channels, so half of them decide, and residuals are clipped at five robust
    deviations. 0 without pairs.
    """
    if not len(before):
        return 0.0
    most = OUTLIER * NORMAL_MAD * np.maximum(np.median(np.abs(before), axis=0), _SMALLEST)
    first, second = (np.clip(part, -most, most) for part in (before, after))
    power = np.sqrt((first**2).mean(0) * (second**2).mean(0))
    turns = np.sort(-(first * second).mean(0) / np.maximum(power, _SMALLEST**2))
    return float(turns[len(turns) // 2 :].mean())


def consecutive_residuals(
    problem: CalibrationProblem, unit: Float[np.ndarray, " d"], rows: Int[np.ndarray, " windows"]
) -> tuple[tuple[Residuals, Residuals], int]:
    """One-step residuals from logged states and from those a row later, and the control steps spent on them.

    Args:
        problem: Data and simulator.
        unit: Parameters in [-1, 1].
        rows: Rows with a logged state; those without one a row later are left out.
    """
    states, known = problem.states.exact()
    first = np.searchsorted(known, rows)
    first = first[np.isin(first, consecutive_rows(problem.dataset, known))]
    both = np.concatenate([first, first + 1])
    windows = windows_at(problem.dataset, states[both], known[both], 1)
    residuals = window_residuals(problem.simulator, windows, unit[None], problem.typical_change)[0]
    whole = np.isfinite(residuals).all(-1).reshape(2, -1).all(0)
    before, after = residuals.reshape(2, len(first), -1)[:, whole]
    return (before, after), len(both)
