"""Statistics of residuals: which windows are outliers, and whether residuals are noise."""

import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.plan import FEWEST
from madoc.data import stride
from madoc.identification.losses import NORMAL_MAD
from madoc.identification.noise import NOISY_STRIDE, OUTLIER
from madoc.identification.replay import window_residuals
from madoc.identification.windows import consecutive_rows, windows_at

EXACT = 1e-6
"""Residual in typical changes of a stride; smaller ones mean that states were logged without noise."""
LONG_TAILS = 1.1
"""Cost of residuals, in squared standard deviations; above it they are not normal noise, whose cost is 0.8 with
Cauchy's loss and 1 with squares."""
_LARGEST = 3.0
"""Standard deviations of the noise at which residuals are clipped before they are correlated."""
_SMALLEST = 1e-12
"""Residual in typical changes of a channel; smaller ones are rounding errors."""

Residuals = Float[np.ndarray, "pairs channels"]


def outlier_limits(
    values: Float[np.ndarray, "*rows windows"], activity: Float[np.ndarray, " windows"]
) -> tuple[Float[np.ndarray, "*rows 1"], Float[np.ndarray, "*rows 1"]]:
    """The median of windows' values, and the distance from it beyond which a window is an outlier.

    That is `OUTLIER` robust standard deviations. Windows are weighted by their activity: those in which nothing moves
    are all alike, whatever the parameters.
    """
    weights = activity + np.finfo(float).tiny

    def medians(part: np.ndarray) -> np.ndarray:
        return np.quantile(part, 0.5, axis=-1, weights=weights, method="inverted_cdf", keepdims=True)

    middle = medians(values)
    return middle, OUTLIER * NORMAL_MAD * medians(np.abs(values - middle))


def touched(
    problem: CalibrationProblem,
    states: Float[np.ndarray, "known state"],
    known: Int[np.ndarray, " known"],
    rows: Int[np.ndarray, " windows"],
    horizon: int,
) -> Bool[np.ndarray, " windows"]:
    """Whether bodies were in contact at any state of a window, from its first to its last, whose row is known."""
    ends = problem.dataset.episode_ends[problem.dataset.episode_of(rows)]
    touching = np.zeros(len(rows), dtype=bool)
    for later in range(horizon + 1):
        there = np.minimum(rows + later, ends - 1)
        place = np.minimum(np.searchsorted(known, there), len(known) - 1)
        touching |= (problem.simulator.contacts(states[place]) > 0) & (known[place] == there)
    return touching


def without_contacts(
    problem: CalibrationProblem, rows: Int[np.ndarray, " windows"], horizon: int
) -> Int[np.ndarray, " free"]:
    """Rows of windows in which the log shows no contact, or all where these are too few or fewer than the others."""
    free = rows[~touched(problem, *problem.states.guesses(), rows, horizon)]
    return free if len(free) >= max(FEWEST + len(problem.simulator.parameters), len(rows) / 2) else rows


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

    The costs `before` are compared with those `after` each of the steps tried. A change up to `least` is never clipped;
    `failed` is the cost of a window whose simulation failed.
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
    """Largest correlation, over channels, of a reading's residual with the next reading's.

    It is 0 for white noise, and positive for model errors. Residuals are in standard deviations of the noise and
    clipped at three of them; a channel with smaller residuals than its noise counts as uncorrelated.
    """
    clipped = np.clip(residuals, -_LARGEST, _LARGEST)
    power = np.maximum((clipped**2).sum((0, 1)), clipped[..., 0].size)
    return float(((clipped[:, 1:] * clipped[:, :-1]).sum((0, 1)) / power).max())


def consecutive_residuals(
    problem: CalibrationProblem, point: Float[np.ndarray, " d"], rows: Int[np.ndarray, " windows"]
) -> tuple[Residuals, Residuals]:
    """One-step residuals from logged states and from those a row later.

    `point` are parameters in [-1, 1], `rows` have a logged state; those without one a row later are left out.
    """
    states, known = problem.states.exact()
    first = np.searchsorted(known, rows)
    first = first[np.isin(first, consecutive_rows(problem.dataset, known))]
    both = np.concatenate([first, first + 1])
    windows = windows_at(problem.dataset, states[both], known[both], 1)
    residuals = window_residuals(problem.simulator, windows, point[None], problem.typical_change)[0]
    pairs = residuals.reshape(2, len(first), residuals.shape[-1])
    before, after = pairs[:, np.isfinite(pairs).all((0, 2))]
    return before, after


def noisy_rows(problem: CalibrationProblem) -> bool:
    """Whether noise hides the motion from row to row, in a log whose rate is high for its robot.

    There noise need not alternate: steps of an encoder and filters of a drive last for several rows.
    """
    loud = problem.noise_by_differences > NOISY_STRIDE * problem.typical_change
    return stride(problem.dataset) > 1 and bool(loud.any())
