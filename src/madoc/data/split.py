"""A hold-out: episodes of a log that no method sees, to judge its estimate by."""

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Int, PRNGKeyArray

from madoc.data.dataset import Dataset, close_episodes
from madoc.errors import MadocError

STRETCHES = 10
"""Number of stretches that a log of one episode is cut into, to hold some of them out."""
_SHORTEST = 20
"""Smallest mean number of rows in a stretch; of a shorter log of one episode the last rows are held out instead."""


@dataclass(frozen=True)
class Split:
    """A log in two parts.

    Attributes:
        kept: The rows that methods calibrate to.
        held: The rows that their estimates are judged by.
        sentence: How the rows were chosen.
    """

    kept: Dataset
    held: Dataset
    sentence: str


def hold_out(dataset: Dataset, share: float, key: PRNGKeyArray) -> Split:
    """Hold out about `share` of the rows: whole episodes drawn at random, at least one on each side.

    An episode joins those held out where that brings their rows nearer to the share. A log of one episode, or of some
    so uneven that whole ones come to less than half or more than twice the share, is cut into stretches, and some of
    them are held out: the end alone of a run may not be like the rest, of a robot that has come to its goal. A log of
    one episode too short for that has its last rows held out.

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
    lengths = dataset.episode_ends - starts
    held = _drawn(lengths, share, np.asarray(jax.random.permutation(key, len(starts))))
    fits = 0.5 <= lengths[held].sum() / (share * rows) <= 2.0
    if not fits and rows >= STRETCHES * _SHORTEST and lengths.max() > 1.5 * rows / STRETCHES:
        return _stretches(dataset, share, key)
    kept, rest = (episodes_of(dataset, np.flatnonzero(side)) for side in (~held, held))
    sentence = f"{int(held.sum()):,} of {len(starts):,} episodes are held out, {len(rest):,} of {rows:,} rows"
    return Split(kept, rest, sentence)


def _stretches(dataset: Dataset, share: float, key: PRNGKeyArray) -> Split:
    """Split a log of few or uneven episodes: long ones are cut into stretches, each of which counts as an episode."""
    rows, spans = len(dataset), zip(dataset.episode_starts, dataset.episode_ends, strict=True)
    cuts = [np.linspace(start, end, -(-STRETCHES * (end - start) // rows), endpoint=False) for start, end in spans]
    starts = np.concatenate(cuts).astype(np.int64)
    split = hold_out(_part(replace(dataset, run_names=None), np.arange(rows), starts), share, key)
    held = len(split.held.episode_starts)
    few = "the only episode is" if len(dataset.episode_starts) == 1 else "long episodes are"
    sentence = (
        f"{held} of {len(starts)} stretches are held out, {len(split.held):,} of {rows:,} rows: {few} cut, so they "
        "lie beside those calibrated to"
    )
    return replace(split, sentence=sentence)


def episodes_of(dataset: Dataset, episodes: Int[np.ndarray, " episodes"]) -> Dataset:
    """A dataset of only the given episodes, in the order given."""
    starts, ends = dataset.episode_starts[episodes], dataset.episode_ends[episodes]
    names = None if dataset.run_names is None else tuple(dataset.run_names[episode] for episode in episodes)
    dataset = replace(dataset, run_names=names)
    rows = np.concatenate([np.arange(*span) for span in zip(starts, ends, strict=True)])
    return _part(dataset, rows, np.cumsum([0, *(ends - starts)[:-1]]))


def _drawn(lengths: np.ndarray, share: float, order: np.ndarray) -> np.ndarray:
    """A mask of the episodes that are held out."""
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
