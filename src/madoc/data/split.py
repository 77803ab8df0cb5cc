"""A hold-out: episodes of a log that no method sees, to judge its estimate by."""

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Int, PRNGKeyArray

from madoc.data.dataset import Dataset, close_episodes
from madoc.errors import MadocError

STRETCHES = 10
"""That a log of one episode is cut into."""
_SHORTEST = 20
"""Rows of a stretch."""


@dataclass(frozen=True)
class Split:
    """A log in two parts.

    Attributes:
        kept: What methods calibrate to.
        held: What their estimates are judged by.
        sentence: How it was split.
    """

    kept: Dataset
    held: Dataset
    sentence: str


def hold_out(dataset: Dataset, share: float, key: PRNGKeyArray) -> Split:
    """Hold out about `share` of the rows: whole episodes drawn at random, at least one on each side.

    An episode joins those held out where that brings their rows nearer to the share. A log of one episode is cut into
    stretches, and some of them are held out: its end alone may not be like the rest, a robot that has come to its goal.
    One too short for that has its last rows held out.

    Raises:
        MadocError: The share is not between 0 and 1, or there are fewer than 2 rows.
    """
    if not 0.0 < share < 1.0:
        raise MadocError(f"expected a share of the rows to hold out between 0 and 1, got {share}")
    rows, starts = len(dataset), dataset.episode_starts
    if rows < 2:
        raise MadocError(f"expected at least 2 rows to hold one out, got {rows} in {dataset.origin}")
    if len(starts) == 1 and rows >= STRETCHES * _SHORTEST:
        return _stretches(dataset, share, key)
    if len(starts) == 1:
        cut = min(rows - 1, max(1, round((1.0 - share) * rows)))
        begin = np.zeros(1, np.int64)
        return Split(
            _part(dataset, np.arange(cut), begin),
            _part(dataset, np.arange(cut, rows), begin),
            f"the last {rows - cut:,} of {rows:,} rows are held out: there is only one episode, so they directly "
            "follow those calibrated to",
        )
    held = _drawn(dataset.episode_ends - starts, share, np.asarray(jax.random.permutation(key, len(starts))))
    kept, rest = (episodes_of(dataset, np.flatnonzero(side)) for side in (~held, held))
    sentence = f"{int(held.sum()):,} of {len(starts):,} episodes are held out, {len(rest):,} of {rows:,} rows"
    return Split(kept, rest, sentence)


def _stretches(dataset: Dataset, share: float, key: PRNGKeyArray) -> Split:
    """A log of one episode, as if each of its stretches were one."""
    starts = np.linspace(0, len(dataset), STRETCHES, endpoint=False).astype(np.int64)
    split = hold_out(_part(dataset, np.arange(len(dataset)), starts), share, key)
    held = len(split.held.episode_starts)
    sentence = (
        f"{held} of {STRETCHES} stretches of the only episode are held out, {len(split.held):,} of {len(dataset):,} "
        "rows; they lie beside those calibrated to"
    )
    return replace(split, sentence=sentence)


def episodes_of(dataset: Dataset, episodes: Int[np.ndarray, " episodes"]) -> Dataset:
    """A dataset of only the given episodes, in the order given."""
    starts, ends = dataset.episode_starts[episodes], dataset.episode_ends[episodes]
    rows = np.concatenate([np.arange(*span) for span in zip(starts, ends, strict=True)])
    return _part(dataset, rows, np.cumsum([0, *(ends - starts)[:-1]]))


def _drawn(lengths: np.ndarray, share: float, order: np.ndarray) -> np.ndarray:
    """Which episodes are held out."""
    wanted, taken = share * lengths.sum(), 0
    held = np.zeros(len(lengths), dtype=bool)
    for episode in order:
        nearer = lengths[episode] < 2.0 * (wanted - taken)
        if nearer and held.sum() < len(lengths) - 1:
            held[episode] = True
            taken += lengths[episode]
    if not held.any():
        held[order[np.argmin(lengths[order])]] = True
    return held


def _part(dataset: Dataset, rows: np.ndarray, starts: np.ndarray) -> Dataset:
    transitions = close_episodes(dataset.transitions.take(rows), starts)
    return replace(dataset, transitions=transitions, episode_starts=starts)
