"""How noisy the sensors of a log are, from the log alone."""

from itertools import combinations_with_replacement

import numpy as np
from jaxtyping import Float

from madoc.data.dataset import Dataset

_ROWS = 20_000
"""Of the log, at most; more would hardly change a variance."""
_TELLING = 0.3
"""Slope of the next observation by the one before it, below which nothing can be said of that channel."""


def estimate_noise(dataset: Dataset) -> Float[np.ndarray, " observation"]:
    """Deviation of each channel's noise, 0 where none is seen.

    A reading that is too high raises what is foreseen from it: of s' = f(s, a) + e' - F e, fitted by a regression on
    s, a and their products, the residuals of consecutive rows correlate by -F σ². What the regression cannot follow
    hides noise smaller than itself, as it errs alike in consecutive rows: this is a lower bound, and noise well below
    a step's change shows only in motion that a quadratic follows.
    """
    logged = dataset.transitions
    observation, action, following = (
        np.asarray(part)[:_ROWS] for part in (logged.observation, logged.action, logged.next_observation)
    )
    count = observation.shape[1]
    columns = np.concatenate([observation, action], axis=-1)
    spread = columns.std(0)
    scale = np.where(spread > 1e-8, spread, 1.0)
    columns = (columns - columns.mean(0)) / scale
    products = [columns[:, i] * columns[:, j] for i, j in combinations_with_replacement(range(columns.shape[1]), 2)]
    inputs = np.column_stack([columns, *products, np.ones(len(columns))])
    weights = np.linalg.lstsq(inputs, following, rcond=None)[0]
    residual = following - inputs @ weights
    slope = np.diagonal(weights[:count]) / scale[:count]
    inner = np.ones(len(residual), dtype=bool)
    inner[dataset.episode_starts[dataset.episode_starts < len(residual)]] = False
    shared = (residual[1:] * residual[:-1])[inner[1:]].mean(0)
    told = np.abs(slope) > _TELLING
    return np.sqrt(np.maximum(0.0, np.where(told, -shared / np.where(told, slope, 1.0), 0.0)))
