"""A dataset: logged transitions, where their episodes begin and come from; its time scale, and a hold-out."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from madoc.data.disturbance import Disturbance
from madoc.data.findings import Finding
from madoc.errors import MadocError
from madoc.simulation.attitudes import Attitudes, differences
from madoc.types import Transitions, generator

STEPS = 20
"""Number of steps of comparison in a time scale, 1 or more. Rows that are closer together are taken together."""
_MOST_PAIRS = 20_000
"""Largest number of pairs of rows that a mean squared change is computed from; more would hardly change it."""
_LAGS = 96
"""Number of lags that are tried, spaced evenly in their logarithm."""

STRETCHES = 10
"""Number of stretches that a log of one episode is cut into, at least 2; some of them are held out."""
_SHORTEST = 20
"""Mean rows of a stretch, at least; of a shorter log of one episode the last rows are held out instead."""


@dataclass(frozen=True)
class Dataset:
    """Logged transitions of one robot.

    Attributes:
        transitions: NumPy, float64 and bool; actions in [-1, 1]. The last row of every episode is terminated
            or truncated. No row pairs observations of two episodes.
        episode_starts: Rows where an episode begins, ascending; the first is 0.
        task_name: The task it was recorded for.
        physics: `legacy`, `modern`, or `unknown` where the file does not say.
        origin: The file, or a description.
        true_parameters: The target's physical values by parameter name, where available. Only evaluation reads them.
        disturbance: The noise, missing velocities and lost order that were put into it.
        run_names: The run that each episode is from, where it was read from a user's logs.
        findings: Notes and warnings of the reader.
    """

    transitions: Transitions
    episode_starts: Int[np.ndarray, " episodes"]
    task_name: str
    physics: str
    origin: str
    true_parameters: dict[str, float] | None = None
    disturbance: Disturbance = field(default_factory=Disturbance)
    run_names: tuple[str, ...] | None = None
    findings: tuple[Finding, ...] = ()

    def __len__(self) -> int:
        return len(self.transitions)

    @property
    def episode_ends(self) -> Int[np.ndarray, " episodes"]:
        """One past the last row of every episode."""
        return np.append(self.episode_starts, len(self))[1:]

    def episode_of(self, rows: Int[np.ndarray, "*rows"]) -> Int[np.ndarray, "*rows"]:
        """The index of the episode that each of the given rows belongs to."""
        return np.searchsorted(self.episode_starts, rows, side="right") - 1

    @property
    def names_of_runs(self) -> tuple[str, ...]:
        """The run that each episode is from, by its place where it has no name."""
        return self.run_names or tuple(f"run {1 + episode}" for episode in range(len(self.episode_starts)))

    @cached_property
    def time_scale(self) -> int:
        """The time in rows, at least 1, in which the robot goes from one pose to another.

        For each channel that is the shortest lag at which the mean squared change reaches the channel's variance within
        episodes: about 1 / ω for an oscillation of angular frequency ω. The lower quartile over channels counts, as the
        angle of a robot that rests in several poses keeps for long what its speed does not; channels that reach it from
        one row to the next are noise, or too fast for the log, and count only if all do. Unlike a ratio to the change
        from row to row it does not depend on the rate of the log, nor on noise that is smaller than the motion. It is
        at most half of the longest episode, and 1 where the order of rows is lost.
        """
        observation = np.asarray(self.transitions.observation, np.float64)
        episode = self.episode_of(np.arange(len(observation)))
        rows = np.bincount(episode)
        means = np.stack([np.bincount(episode, weights=column) / rows for column in observation.T], axis=-1)
        variance = ((observation - means[episode]) ** 2).mean(0)
        moving = variance > 0.0
        longest = int((self.episode_ends - self.episode_starts).max()) // 2
        if longest < 2 or self.disturbance.shuffled != "none" or not moving.any():
            return 1
        found = np.full(int(moving.sum()), longest)
        for lag in np.unique(np.geomspace(1, longest, _LAGS).round().astype(np.int64))[::-1].tolist():
            pairs = _thinned(np.flatnonzero(episode[lag:] == episode[:-lag]))
            if len(pairs):
                change = observation[pairs + lag][:, moving] - observation[pairs][:, moving]
                found = np.where((change**2).mean(0) >= variance[moving], lag, found)
        slow = found[found > 1]
        return int(np.quantile(slow if len(slow) else found, 0.25, method="lower"))

    def take(self, rows: Int[np.ndarray, " rows"], starts: Int[np.ndarray, " episodes"]) -> "Dataset":
        """A dataset of the given rows in their order, with the episode starts that they have there.

        An episode is named after the run of its first row, and is truncated where it ends without being terminated.
        """
        names = self.run_names
        return replace(
            self,
            transitions=close_episodes(self.transitions.take(rows), starts),
            episode_starts=starts,
            run_names=None if names is None else tuple(names[episode] for episode in self.episode_of(rows[starts])),
        )

    def split(self, share: float = 0.2, *, key: PRNGKeyArray | None = None) -> tuple["Dataset", "Dataset"]:
        """Hold out about `share` of the rows to judge an estimate by: `train, held_out = dataset.split(0.2)`.

        Whole episodes are held out, or stretches where there are few; `hold_out` says how, and what it refuses. The
        key draws the episodes; without one, the draw is always the same.
        """
        parts = hold_out(self, share, jax.random.key(0) if key is None else key)
        return parts.kept, parts.held


def starts_after(ends: Bool[np.ndarray, " rows"]) -> Int[np.ndarray, " episodes"]:
    """Rows where an episode begins, from whether each row ends one."""
    return np.flatnonzero(np.append(True, ends)[:-1])


def close_episodes(transitions: Transitions, episode_starts: Int[np.ndarray, " episodes"]) -> Transitions:
    """Mark the last row of every episode truncated unless it is terminated: the record ends there."""
    last = np.append(episode_starts, len(transitions))[1:] - 1
    truncated = np.array(transitions.truncated)
    truncated[last] |= ~np.asarray(transitions.terminated)[last]
    return replace(transitions, truncated=truncated)


def join(datasets: Sequence[Dataset], origin: str) -> Dataset:
    """Datasets of one robot as one, their rows one after another."""
    offsets = np.cumsum([0, *(len(dataset) for dataset in datasets[:-1])])
    starts = [dataset.episode_starts + offset for dataset, offset in zip(datasets, offsets, strict=True)]
    return replace(
        datasets[0],
        transitions=jax.tree.map(
            lambda *columns: np.concatenate(columns), *(dataset.transitions for dataset in datasets)
        ),
        episode_starts=np.concatenate(starts),
        origin=origin,
        run_names=tuple(name for dataset in datasets for name in dataset.run_names or ()) or None,
        findings=tuple(finding for dataset in datasets for finding in dataset.findings),
    )


def subsample(dataset: Dataset, max_transitions: int, key: PRNGKeyArray) -> Dataset:
    """At most `max_transitions` transitions: whole episodes in a random order, the last one cut short.

    The draw depends on the lengths of the episodes alone, so it is the same for every file format, and a smaller draw
    with the same key is the beginning of a larger one. A dataset that is small enough is returned as it is; else its
    findings say how many rows were kept.

    Raises:
        MadocError: `max_transitions` is not positive.
    """
    if max_transitions < 1:
        raise MadocError(f"expected max_transitions of at least 1, got {max_transitions}")
    if max_transitions >= len(dataset):
        return dataset
    starts, ends = dataset.episode_starts, dataset.episode_ends
    order = np.asarray(jax.random.permutation(key, len(starts)))
    filled = np.cumsum((ends - starts)[order])
    episodes = int(np.searchsorted(filled, max_transitions)) + 1
    rows = np.concatenate([np.arange(starts[episode], ends[episode]) for episode in order[:episodes]])
    kept = dataset.take(rows[:max_transitions], np.append(0, filled[: episodes - 1]))
    what = f"{max_transitions:,} of {len(dataset):,} rows are used, of episodes drawn at random, the last one cut short"
    return replace(kept, findings=(*kept.findings, Finding("note", what, do="a larger --max-transitions uses more")))


def spread_of(rows: Float[np.ndarray, "*rows values"]) -> Float[np.ndarray, " values"]:
    """Standard deviation of every channel over all rows; 1 for one that never moves."""
    spread = rows.reshape(-1, rows.shape[-1]).std(0)
    return np.where(spread > 1e-8, spread, 1.0)


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


@dataclass(frozen=True)
class Split:
    """A log in two parts, rows that methods calibrate to and rows that judge them, and how these were chosen."""

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
