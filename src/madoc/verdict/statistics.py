"""Numbers with intervals: resampled episodes, ranks of two samples, and how far a pairing is from chance."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import rankdata

RESAMPLES = 500
"""Enough for a 95 % interval: its ends vary by about a tenth of its width (Efron and Tibshirani 1993, section 13.3)."""
CONFIDENCE = 0.95
FEWEST_EPISODES = 5
"""With fewer, episodes say little of how they differ, and windows are resampled in their place."""
SHUFFLES = 499
_CAPPING = 20
"""Random pairings that say what hardly any pair exceeds."""
"""The smallest p-value is then 1 / 500."""


def resampled(
    values: Float[np.ndarray, "windows *kinds"], groups: Int[np.ndarray, " windows"], *, seed: int = 0
) -> Float[np.ndarray, "resamples *kinds"]:
    """Means over windows of resampled groups, all kinds under the same draws, so that they can be compared.

    Args:
        values: One row a window.
        groups: The episode of each window; with fewer than `FEWEST_EPISODES` every window is its own group.
        seed: Of the draws.
    """
    if len(np.unique(groups)) < FEWEST_EPISODES:
        groups = np.arange(len(values))
    _, member = np.unique(groups, return_inverse=True)
    count = int(member.max()) + 1
    flat = values.reshape(len(values), -1)
    sums = np.zeros((count, flat.shape[1]))
    np.add.at(sums, member, flat)
    sizes = np.bincount(member)
    drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1.0 / count), RESAMPLES)
    return (drawn @ sums / (drawn @ sizes)[:, None]).reshape(RESAMPLES, *values.shape[1:])


def interval_of(draws: Float[np.ndarray, "resamples *kinds"]) -> Float[np.ndarray, "2 *kinds"]:
    """The percentile interval."""
    tail = 50.0 * (1.0 - CONFIDENCE)
    return np.percentile(draws, [tail, 100.0 - tail], axis=0)


def area_under_curve(
    scores: Float[np.ndarray, " rows"],
    real: Bool[np.ndarray, " rows"],
    weights: Float[np.ndarray, " rows"] | None = None,
) -> float:
    """How often a real row's score is above a simulated row's, ties counted half; rows may count unequally."""
    if weights is None:
        ranks, count = rankdata(scores), int(real.sum())
        return float((ranks[real].sum() - count * (count + 1) / 2.0) / (count * (len(real) - count)))
    order = np.argsort(scores, kind="stable")
    ordered, mass = scores[order], np.where(real[order], 0.0, weights[order])
    below = np.concatenate([[0.0], np.cumsum(mass)])
    first, last = np.searchsorted(ordered, scores[real], "left"), np.searchsorted(ordered, scores[real], "right")
    beaten = (below[first] + below[last]) / 2.0
    return float((weights[real] * beaten).sum() / weights[real].sum() / mass.sum())


def better_than_chance(
    predicted: Float[np.ndarray, "rows values"],
    followed: Float[np.ndarray, "rows values"],
    groups: Int[np.ndarray, " rows"],
    *,
    seed: int = 0,
) -> dict[str, Any]:
    """Whether predictions belong to the rows they were made for: against the same rows paired at random.

    Rows are exchanged within their group where groups have several rows on average, else among all: what only tells
    one run from another is no dynamics.

    Errors are means, each row's cut off at what hardly any random pair exceeds: a median would only speak of the rows
    at rest where those are most.

    Returns:
        `skill`, 1 - error over the median error at random, and `p`, how often chance does as well.
    """
    rng = np.random.default_rng(seed)
    _, member, sizes = np.unique(groups, return_inverse=True, return_counts=True)
    if len(member) < 2 * len(sizes):
        member = np.zeros_like(member)
    home = np.argsort(member, kind="stable")

    def sizes_of(of: np.ndarray) -> np.ndarray:
        return np.abs(predicted - of).mean(-1)

    def shuffled() -> np.ndarray:
        order = np.empty(len(member), np.int64)
        order[home] = np.lexsort((rng.random(len(member)), member))
        return followed[order]

    cap = np.percentile(np.concatenate([sizes_of(shuffled()) for _ in range(_CAPPING)]), 95)

    def error(of: np.ndarray) -> float:
        return float(np.minimum(sizes_of(of), cap).mean())

    paired = error(followed)
    chance = np.array([error(shuffled()) for _ in range(SHUFFLES)])
    typical = float(np.median(chance))
    return {
        "skill": 0.0 if typical == 0.0 else 1.0 - paired / typical,
        "p": float((1 + (chance <= paired).sum()) / (1 + SHUFFLES)),
    }
