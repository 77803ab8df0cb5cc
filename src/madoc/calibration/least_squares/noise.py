"""How noisy each channel's sensor is, from what a fit leaves of its readings; and whether it is noise that is left."""

import numpy as np
from jaxtyping import Float, Int

from madoc.calibration.base import CalibrationProblem
from madoc.identification.losses import NORMAL_MAD
from madoc.identification.replay import window_residuals
from madoc.identification.windows import consecutive_rows, windows_at

LOUDEST = 3.0
"""Deviations of the noise that a residual counts as at most, where residuals are correlated."""
UNLIKE = 5.0
"""Robust deviations from the middle; of normal values one in two million is farther."""
_SMALLEST = 1e-12
"""In units of a channel's typical change; below this it is rounding."""


def unlike(
    values: Float[np.ndarray, "*rows windows"], activity: Float[np.ndarray, " windows"]
) -> tuple[Float[np.ndarray, "*rows 1"], Float[np.ndarray, "*rows 1"]]:
    """The middle of windows' values, and how far from it one may be and still be like the others: 5 deviations.

    Both by weighted medians. Windows in which nothing moves are all alike and say little: windows weigh by how much
    happens in them.
    """
    weights = np.broadcast_to(activity + np.finfo(float).tiny, values.shape)

    def middle_of(part: np.ndarray) -> np.ndarray:
        found = [
            np.quantile(row, 0.5, weights=own, method="inverted_cdf") for row, own in zip(part, weights, strict=True)
        ]
        return np.array(found)[:, None]

    rows = values.reshape(-1, values.shape[-1])
    weights = weights.reshape(rows.shape)
    middle = middle_of(rows)
    reach = UNLIKE * NORMAL_MAD * middle_of(np.abs(rows - middle))
    shape = (*values.shape[:-1], 1)
    return middle.reshape(shape), reach.reshape(shape)


def noise_ratio(
    residuals: Float[np.ndarray, "windows values"],
    weights: Float[np.ndarray, "windows values"],
    share: float,
    freedom: float,
) -> float:
    """Variance of what a reading pulls with, ψ, over ψ', its mean curvature; 1 for squares of deviations."""
    pull = ((weights * residuals) ** 2).sum() / max(1.0, freedom)
    curvature = share * weights.sum() / max(1, weights.size)
    return float(pull / max(curvature, _SMALLEST))


Residuals = Float[np.ndarray, "pairs channels"]


def consecutive_residuals(
    problem: CalibrationProblem, unit: Float[np.ndarray, " d"], chosen: Int[np.ndarray, " states"]
) -> tuple[tuple[Residuals, Residuals], int]:
    """One-step residuals from logged states and from those a row later, and the control steps spent on them.

    Args:
        problem: Data and simulator.
        unit: Parameters in [-1, 1].
        chosen: Which logged states to take; those without one a row later are left out.
    """
    (states, rows), dataset = problem.states.exact(), problem.dataset
    first = chosen[np.isin(chosen, consecutive_rows(dataset, rows))]
    both = np.concatenate([first, first + 1])
    windows = windows_at(dataset, states[both], rows[both], 1)
    residuals = window_residuals(problem.simulator, windows, unit[None], problem.typical_change)[0]
    whole = np.isfinite(residuals).all(-1).reshape(2, -1).all(0)
    before, after = residuals.reshape(2, len(first), -1)[:, whole]
    return (before, after), len(both)


def echo(residuals: Float[np.ndarray, "windows readings channels"]) -> float:
    """Correlation of a reading's residual with the next one's, of the channel that has most of it.

    Noise has none, what a model does wrong has. Residuals are in deviations of the noise; of a channel that leaves less
    than that nothing is said, and none counts more than `LOUDEST` deviations.
    """
    clipped = np.clip(residuals, -LOUDEST, LOUDEST)
    power = np.maximum((clipped**2).sum((0, 1)), clipped[..., 0].size)
    return float(((clipped[:, 1:] * clipped[:, :-1]).sum((0, 1)) / power).max())


def takes_turns(before: Residuals, after: Residuals) -> float:
    """Minus the correlation of a channel's residual with the next row's, the mean over the half that have most of it.

    Of noise e alone a residual is about e' - e, as the reading it starts at carries noise as well as the one it ends
    at: the next one is e'' - e', and they correlate by -1/2. What a model does wrong it does wrong in the next row too.
    Contacts answer to noise in ways of their own, in some channels: so half of them decide, and residuals count up to
    five times the median. 0 without pairs.
    """
    if not len(before):
        return 0.0
    most = UNLIKE * NORMAL_MAD * np.maximum(np.median(np.abs(before), axis=0), _SMALLEST)
    first, second = (np.clip(part, -most, most) for part in (before, after))
    power = np.sqrt((first**2).mean(0) * (second**2).mean(0))
    turns = np.sort(-(first * second).mean(0) / np.maximum(power, _SMALLEST**2))
    return float(turns[len(turns) // 2 :].mean())
