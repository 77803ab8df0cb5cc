"""A hold-out: episodes of a log that no method sees, to judge its estimate by."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int, PRNGKeyArray

from madoc.data.dataset import Dataset
from madoc.errors import MadocError
from madoc.types import generator

STRETCHES = 10
"""Number of stretches that a log of one episode is cut into, at least 2; some of them are held out."""
_SHORTEST = 20
"""Mean rows of a stretch, at least; of a shorter log of one episode the last rows are held out instead."""


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


def check_share(share: float) -> None:
    """Refuse a share of rows to hold out that is not between 0 and 1."""
    if not 0.0 < share < 1.0:
        raise MadocError(f"expected a share of the rows to hold out between 0 and 1, got {share}")


def hold_out(dataset: Dataset, share: float, key: PRNGKeyArray) -> Split:
    """Hold out about `share` of the rows: whole episodes drawn at random, at least one on each side.

    An episode is held out where that brings the number of rows held out nearer to the share. A log of one episode is
    cut into stretches and some of them are held out, because the end of a run may differ from the rest, as when the
    robot has reached its goal. So is a log whose whole episodes are so uneven that they give less than half or more
    than twice the share. Of a single episode too short to cut, the last rows are held out.

    Raises:
        MadocError: The share is not between 0 and 1, or there are fewer than 2 rows.
    """
    check_share(share)
    rows, starts = len(dataset), dataset.episode_starts
    if rows < 2:
        raise MadocError(f"expected at least 2 rows to hold one out, got {rows} in {dataset.origin}")
    if len(starts) == 1 and rows >= STRETCHES * _SHORTEST:
        return _stretches(dataset, share, key)
    if len(starts) == 1:
        cut = min(rows - 1, max(1, round((1.0 - share) * rows)))
        return Split(
            dataset.take(np.arange(cut), starts),
            dataset.take(np.arange(cut, rows), starts),
            f"the last {rows - cut:,} of {rows:,} rows are held out: there is only one episode, so they directly "
            "follow those calibrated to",
        )
    lengths = dataset.episode_ends - starts
    held = _drawn(lengths, share, generator(key).permutation(len(starts)))
    fits = 0.5 <= lengths[held].sum() / (share * rows) <= 2.0
    if not fits and rows >= STRETCHES * _SHORTEST and lengths.max() > 1.5 * rows / STRETCHES:
        return _stretches(dataset, share, key)
    kept, rest = (episodes_of(dataset, np.flatnonzero(side)) for side in (~held, held))
    sentence = f"{int(held.sum()):,} of {len(starts):,} episodes are held out, {len(rest):,} of {rows:,} rows"
    return Split(kept, rest, sentence)


def _stretches(dataset: Dataset, share: float, key: PRNGKeyArray) -> Split:
    """Cut long episodes into stretches, and hold out some of these as if they were episodes."""
    rows, spans = len(dataset), zip(dataset.episode_starts, dataset.episode_ends, strict=True)
    cuts = [np.linspace(start, end, -(-STRETCHES * (end - start) // rows), endpoint=False) for start, end in spans]
    starts = np.concatenate(cuts).astype(np.int64)
    split = hold_out(dataset.take(np.arange(rows), starts), share, key)
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
    rows = np.concatenate([np.arange(*span) for span in zip(starts, ends, strict=True)])
    return dataset.take(rows, np.cumsum([0, *(ends - starts)[:-1]]))


def _drawn(lengths: np.ndarray, share: float, order: np.ndarray) -> np.ndarray:
    """Mask of the episodes that are held out, chosen in the given order until the share of the rows is met."""
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
