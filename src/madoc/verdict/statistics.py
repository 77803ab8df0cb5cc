"""Means with confidence intervals from a bootstrap, and predictions compared with chance and with noise."""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float, Int

from madoc.calibration.holdout import PredictionError, PredictionErrors
from madoc.identification.fitted_windows import NEGLIGIBLE
from madoc.identification.information import CONFIDENCE

ABOVE_NOISE = 2.0
"""Ratio of an error to that of noise alone, at least 1; above it noise does not explain the error. Noise estimated from
a few hundred rows is within about 50 % of the true one."""
WORTH_GAINING = 0.05
"""Share in [0, 1] of mid-range's error that parameters can remove; below it mid-range is as good."""
RESAMPLES = 500
"""Number of bootstrap samples. The ends of a 95 % interval then vary by about a tenth of its width (Efron and
Tibshirani 1993, section 13.3)."""
FEWEST_GROUPS = 5
"""Smallest number of groups that are resampled. Few make the percentile interval somewhat too narrow."""
SHUFFLES = 499
"""Number of random pairings. The smallest p-value is then 1 / 500."""
_CAPPING = 20
"""Number of random pairings whose 95th percentile of errors caps the error of a row."""


def independent_groups(
    episodes: Int[np.ndarray, " windows"], rows: Int[np.ndarray, " windows"], steps: int
) -> Int[np.ndarray, " windows"]:
    """The group of each window, for a bootstrap that resamples groups, as windows of one episode are not independent.

    Episodes are groups where there are `FEWEST_GROUPS` or more. Else stretches of an episode are, of twice the `steps`
    of a window, so that windows of different groups overlap only where stretches meet. If these are too few as well,
    consecutive fifths of all windows are groups.
    """
    first = np.array([rows[episodes == episode].min() for episode in episodes])
    stretch = (rows - first) // (2 * steps)
    stretches = np.unique(np.stack([episodes, stretch], axis=1), axis=0, return_inverse=True)[1].reshape(-1)
    for groups in (episodes, stretches):
        if len(np.unique(groups)) >= FEWEST_GROUPS:
            return groups
    return np.arange(len(rows)) * FEWEST_GROUPS // len(rows)


def resampled(
    values: Float[np.ndarray, " windows *kinds"], groups: Int[np.ndarray, " windows"]
) -> Float[np.ndarray, " resamples *kinds"]:
    """Bootstrap samples of means over windows: whole groups are resampled, every kind of value by the same draws."""
    _, member = np.unique(groups, return_inverse=True)
    count = int(member.max()) + 1
    flat = values.reshape(len(values), -1)
    sums = np.zeros((count, flat.shape[1]))
    np.add.at(sums, member, flat)
    sizes = np.bincount(member)
    drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), RESAMPLES)
    return (drawn @ sums / (drawn @ sizes)[:, None]).reshape(RESAMPLES, *values.shape[1:])


def interval_of(draws: Float[np.ndarray, " resamples *kinds"]) -> Float[np.ndarray, " 2 *kinds"]:
    """The percentile interval of bootstrap samples."""
    tail = 50.0 * (1.0 - CONFIDENCE)
    return np.percentile(draws, [tail, 100.0 - tail], axis=0)


def prediction_errors(
    sizes: Float[np.ndarray, "windows points horizons signals"],
    floor: Float[np.ndarray, "windows horizons signals"],
    best: int,
    *,
    groups: Int[np.ndarray, " windows"],
    horizons: Sequence[int],
    stride: int,
) -> PredictionErrors:
    """Prediction errors of several points at each horizon, with confidence intervals.

    `sizes` are absolute residuals at mid-range, at the estimate, then at points near it, and `floor` those that noise
    alone would cause. `best` is the point of `best_of`, `groups` are those of `independent_groups`, and `stride` is
    the control steps of the residuals' unit.
    """
    means, draws = sizes.mean((0, -1)), resampled(sizes.mean(-1), groups)
    relative = relative_to_first(means)
    noise_alone = relative_to_first(np.stack([means[0], floor.mean((0, -1))]))[1]
    low, high = interval_of(relative_to_first(draws)[:, 1])
    mid_range, estimate, nearby_best, noise = (
        _by_horizon(kind, groups, horizons) for kind in (sizes[:, 0], sizes[:, 1], sizes[:, best], floor)
    )
    return PredictionErrors(
        mid_range=mid_range,
        estimate=estimate,
        nearby_best=nearby_best,
        noise=noise,
        relative=float(relative[1]),
        relative_interval=(float(low), float(high)),
        nearby_relative=float(max(relative[best], min(relative[1], noise_alone))),
        windows=len(sizes),
        stride=stride,
    )


def best_of(sizes: Float[np.ndarray, "windows points horizons signals"]) -> int:
    """Index of the point with the smallest errors; the first point, mid-range, is no candidate."""
    return 1 + int(np.argmin(relative_to_first(sizes.mean((0, -1)))[1:]))


def _by_horizon(
    sizes: Float[np.ndarray, "windows horizons signals"],
    groups: Int[np.ndarray, " windows"],
    horizons: Sequence[int],
) -> tuple[PredictionError, ...]:
    low, high = interval_of(resampled(sizes.mean(-1), groups)).tolist()
    means = [float(sizes[:, index].mean()) for index in range(len(horizons))]
    columns = zip(horizons, means, zip(low, high, strict=True), strict=True)
    return tuple(PredictionError(*row) for row in columns)


def relative_to_first(errors: Float[np.ndarray, "*draws points horizons"]) -> Float[np.ndarray, "*draws points"]:
    """Each point's error over the first point's, mean over horizons; at least 1 where the first's is negligible."""
    first = errors[..., :1, :]
    negligible = first <= NEGLIGIBLE
    ratio = errors / np.where(negligible, 1.0, first)
    return np.where(negligible, np.maximum(1.0, errors / NEGLIGIBLE), ratio).mean(-1)


def better_than_chance(
    predicted: Float[np.ndarray, "rows values"],
    followed: Float[np.ndarray, "rows values"],
    groups: Int[np.ndarray, " rows"],
) -> tuple[float, float]:
    """Permutation test of whether predictions belong to the rows they were made for.

    Rows are exchanged within their group where groups have two rows or more on average, else among all: differences
    between runs are no dynamics. The error is a mean in which each row's error is capped at the 95th percentile of
    random pairings; a median would ignore the rows in motion where most rows are at rest.

    Returns:
        The skill, 1 - error over the median error of random pairings, and the p-value.
    """
    rng = np.random.default_rng(0)
    _, member, sizes = np.unique(groups, return_inverse=True, return_counts=True)
    if len(member) < 2 * len(sizes):
        member = np.zeros_like(member)
    home = np.argsort(member, kind="stable")

    def errors(of: np.ndarray) -> np.ndarray:
        return np.abs(predicted - of).mean(-1)

    def shuffled() -> np.ndarray:
        order = np.empty(len(member), np.int64)
        order[home] = np.lexsort((rng.random(len(member)), member))
        return followed[order]

    cap = np.percentile(np.concatenate([errors(shuffled()) for _ in range(_CAPPING)]), 95)

    def mean_error(of: np.ndarray) -> float:
        return float(np.minimum(errors(of), cap).mean())

    paired = mean_error(followed)
    chance = np.array([mean_error(shuffled()) for _ in range(SHUFFLES)])
    typical = float(np.median(chance))
    return 0.0 if typical == 0.0 else 1.0 - paired / typical, float((1 + (chance <= paired).sum()) / (1 + SHUFFLES))


def beyond_noise(
    errors: Sequence[PredictionError], noise: Iterable[PredictionError], *, certain: bool = False
) -> list[tuple[PredictionError, PredictionError]]:
    """The errors that noise does not explain, each with the error of noise alone.

    Where it is to be `certain`, the lower end of an error's interval counts: the mean of a few windows may be as large
    by chance.
    """
    pairs = zip(errors, noise, strict=True)
    least = ((left, alone, left.interval[0] if certain else left.mean) for left, alone in pairs)
    return [(left, alone) for left, alone, size in least if size > max(NEGLIGIBLE, ABOVE_NOISE * alone.mean)]


def beside_random(
    left: Float[np.ndarray, "windows signals"],
    random: Float[np.ndarray, "windows signals"],
    groups: Int[np.ndarray, " windows"],
) -> Float[np.ndarray, " signals"]:
    """How many times as large errors of each signal are as those that noise and random forces make, at least.

    It is the lower end of a 95 % interval by resampling; negligible errors count as `NEGLIGIBLE`.
    """
    kinds = np.maximum(np.stack([left, random], axis=1), NEGLIGIBLE)
    draws = resampled(kinds, groups)
    return interval_of(draws[:, 0] / draws[:, 1])[0]


def hides_gain(errors: PredictionErrors) -> bool:
    """Whether noise hides what parameters gain: none nearby beats mid-range, and all errors are noise's."""
    noisy = errors.noise[0].mean > NEGLIGIBLE
    return noisy and errors.nearby_relative > 1.0 - WORTH_GAINING and not beyond_noise(errors.mid_range, errors.noise)
