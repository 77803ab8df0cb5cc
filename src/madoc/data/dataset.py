"""A dataset: logged transitions, where their episodes begin, and where they come from."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from madoc.data.disturbance import Disturbance
from madoc.data.findings import Finding
from madoc.errors import MadocError
from madoc.types import Transitions


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
        """The time in rows in which the robot goes from one pose to another, at least 1; see `data.timescale`."""
        from madoc.data.timescale import time_scale  # which is built on this module

        return time_scale(self)

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

        Whole episodes are held out, or stretches where there are few; `data.split.hold_out` says how.

        Args:
            share: Share of the rows that are held out, between 0 and 1.
            key: Draws the episodes; without one, the draw is always the same.

        Raises:
            MadocError: The share is not between 0 and 1, or there are fewer than 2 rows.
        """
        from madoc.data.split import hold_out  # which is built on this module

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
