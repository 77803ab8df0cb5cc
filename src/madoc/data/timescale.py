"""A robot's own time scale, from its log, so that nothing depends on the rate at which the log was written."""

import numpy as np
from jaxtyping import Float, Int

from madoc.data.dataset import Dataset, spread_of
from madoc.simulation.attitudes import Attitudes, differences

STEPS = 20
"""Number of steps of comparison in a time scale, 1 or more. Rows that are closer together are taken together."""
_MOST_PAIRS = 20_000
"""Largest number of pairs of rows that a mean squared change is computed from; more would hardly change it."""
_LAGS = 96
"""Number of lags that are tried, spaced evenly in their logarithm."""


def time_scale(dataset: Dataset) -> int:
    """The time in rows, at least 1, in which the robot goes from one pose to another.

    For each channel that is the shortest lag at which the mean squared change reaches the channel's variance within
    episodes: about 1 / ω for an oscillation of angular frequency ω. The lower quartile over channels counts, as the
    angle of a robot that rests in several poses keeps for long what its speed does not; channels that reach it from one
    row to the next are noise, or too fast for the log, and count only if all do. Unlike a ratio to the change from row
    to row it does not depend on the rate of the log, nor on noise that is smaller than the motion. It is at most half
    of the longest episode, and 1 where the order of rows is lost.
    """
    observation = np.asarray(dataset.transitions.observation, np.float64)
    episode = dataset.episode_of(np.arange(len(observation)))
    rows = np.bincount(episode)
    means = np.stack([np.bincount(episode, weights=column) / rows for column in observation.T], axis=-1)
    variance = ((observation - means[episode]) ** 2).mean(0)
    moving = variance > 0.0
    longest = int((dataset.episode_ends - dataset.episode_starts).max()) // 2
    if longest < 2 or dataset.disturbance.shuffled != "none" or not moving.any():
        return 1
    found = np.full(int(moving.sum()), longest)
    for lag in np.unique(np.geomspace(1, longest, _LAGS).round().astype(np.int64))[::-1].tolist():
        pairs = _thinned(np.flatnonzero(episode[lag:] == episode[:-lag]))
        if len(pairs):
            change = observation[pairs + lag][:, moving] - observation[pairs][:, moving]
            found = np.where((change**2).mean(0) >= variance[moving], lag, found)
    slow = found[found > 1]
    return int(np.quantile(slow if len(slow) else found, 0.25, method="lower"))


def _thinned(pairs: Int[np.ndarray, " pairs"]) -> Int[np.ndarray, " kept"]:
    """At most `_MOST_PAIRS` of the pairs, from all of the log: one at random of each of so many equal parts.

    The draw is always the same. Pairs at equal distances would see a periodic motion in the same few poses alone.
    """
    if len(pairs) <= _MOST_PAIRS:
        return pairs
    places = np.arange(_MOST_PAIRS) + np.random.default_rng(0).random(_MOST_PAIRS)
    return pairs[(places * (len(pairs) / _MOST_PAIRS)).astype(np.int64)]


def stride(dataset: Dataset) -> int:
    """Number of rows that make one step of comparison: a 20th of the time scale, at least 1.

    In a log of high rate a robot hardly moves from row to row, and what changes is mostly noise. Residuals are
    therefore multiples of the change in a stride, and lengths of windows are multiples of it.
    """
    return max(1, round(dataset.time_scale / STEPS))


def typical_change(dataset: Dataset, attitudes: Attitudes = ()) -> Float[np.ndarray, " observation"]:
    """Standard deviation of each channel's change in a stride of rows, in its unit; 1 for one that never moves.

    Changes of `attitudes` are rotations, as in `simulation.attitudes`.
    """
    logged, rows = dataset.transitions, stride(dataset)
    observation, following = np.asarray(logged.observation), np.asarray(logged.next_observation)
    last = np.arange(len(dataset)) + rows - 1
    whole = last < dataset.episode_ends[dataset.episode_of(np.arange(len(dataset)))]
    return spread_of(differences(attitudes, following[last[whole]], observation[whole]))
