"""Windows: stretches of consecutive rows of one episode, to be replayed from the state at their first row.

Every function that picks windows takes `rows`, the ascending rows at which one may begin, and returns positions in it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from madoc.data.dataset import Dataset, stride
from madoc.errors import MadocError
from madoc.types import generator

HORIZONS = (1, 5, 20)
"""Window lengths in strides (`data.dataset.stride`) at which simulated and logged motion are compared; the last is the
robot's time scale where the log's rate is high. Most methods fit single steps; an error that is small in each of them
adds up."""

Positions = Int[np.ndarray, " windows"]


def horizons(dataset: Dataset) -> tuple[int, ...]:
    """`HORIZONS` in control steps."""
    rows = stride(dataset)
    return tuple(rows * strides for strides in HORIZONS)


@dataclass(frozen=True)
class Windows:
    """Logged windows of equal length.

    Attributes:
        states: Simulator states at the first rows.
        actions: The actions taken from there.
        following: The observation after each action.
    """

    states: Float[np.ndarray, "windows state"]
    actions: Float[np.ndarray, "windows steps action"]
    following: Float[np.ndarray, "windows steps observation"]

    def __len__(self) -> int:
        return len(self.states)

    @property
    def steps(self) -> int:
        """Length of each window in control steps."""
        return self.actions.shape[1]


def windows_at(
    dataset: Dataset, states: Float[np.ndarray, "windows state"], rows: Int[np.ndarray, " windows"], steps: int
) -> Windows:
    """The windows that begin at the given rows, where the robot was in the given states."""
    stretch = rows[:, None] + np.arange(steps)
    logged = dataset.transitions
    return Windows(states, np.asarray(logged.action)[stretch], np.asarray(logged.next_observation)[stretch])


def readings_at(
    dataset: Dataset, rows: Int[np.ndarray, " windows"], steps: int
) -> Float[np.ndarray, "windows readings observation"]:
    """All observations of the windows that begin at the given rows, the one at the first row included."""
    logged = dataset.transitions
    first = np.asarray(logged.observation)[rows]
    following = np.asarray(logged.next_observation)[rows[:, None] + np.arange(steps)]
    return np.concatenate([first[:, None], following], axis=1)


def rows_that_fit(dataset: Dataset, rows: Int[np.ndarray, " states"], steps: int, *, margin: int = 0) -> Positions:
    """Rows whose episode goes on for `steps` rows, with `margin` rows of the same episode before and after them.

    None where no episode is long enough.
    """
    episode = dataset.episode_of(rows)
    begins, ends = dataset.episode_starts[episode], dataset.episode_ends[episode]
    return np.flatnonzero((rows >= begins + margin) & (rows + steps + margin <= ends))


def first_rows(dataset: Dataset, rows: Int[np.ndarray, " states"], steps: int) -> Positions:
    """Rows whose episode goes on for `steps` rows.

    Raises:
        MadocError: No episode is long enough.
    """
    fitting = rows_that_fit(dataset, rows, steps)
    if not len(fitting):
        longest = int((dataset.episode_ends - dataset.episode_starts).max())
        raise MadocError(
            f"no stretch of {steps} rows begins at a state that can be rebuilt in {dataset.origin}, whose longest "
            f"episode has {longest} rows; take a horizon of 1, or data with its rows in order"
        )
    return fitting


def longest_fit(dataset: Dataset, rows: Int[np.ndarray, " states"], steps: int) -> int:
    """The length of the longest window that fits, at most `steps`."""
    return int(min(steps, (dataset.episode_ends[dataset.episode_of(rows)] - rows).max()))


def disjoint_windows(dataset: Dataset, rows: Int[np.ndarray, " states"], steps: int, *, gap: int = 1) -> Positions:
    """Rows that begin windows of `steps` rows without a common observation, as many as fit one after the other.

    A window has `steps` + 1 observations; the next one begins behind the last of them. With a gap of 0 it begins at the
    last of them, so that only actions are disjoint.

    Raises:
        MadocError: No episode is long enough.
    """
    chosen, free, episode = [], 0, -1
    possible = first_rows(dataset, rows, steps)
    episodes = dataset.episode_of(rows[possible])
    for position, row, own in zip(possible.tolist(), rows[possible].tolist(), episodes.tolist(), strict=True):
        if own != episode or row >= free:
            chosen.append(position)
            free, episode = row + steps + gap, own
    return np.array(chosen)


def successive_windows(
    dataset: Dataset, rows: Int[np.ndarray, " states"], longest: int
) -> tuple[Positions, Int[np.ndarray, " windows"]]:
    """Windows that cover the log one after the other, each at most `longest` rows or up to its episode's end.

    Returns:
        Positions in `rows`, and the length of each window.
    """
    chosen, lengths, free = [], [], -1
    ends = dataset.episode_ends[dataset.episode_of(rows)]
    for position, (row, end) in enumerate(zip(rows.tolist(), ends.tolist(), strict=True)):
        if row >= free:
            chosen.append(position)
            lengths.append(min(longest, end - row))
            free = row + lengths[-1]
    return np.array(chosen), np.array(lengths)


def consecutive_rows(dataset: Dataset, rows: Int[np.ndarray, " states"]) -> Positions:
    """Rows whose next row, of the same episode, is among `rows` as well."""
    episode = dataset.episode_of(rows)
    return np.flatnonzero((np.diff(rows) == 1) & (np.diff(episode) == 0))


def drawn(positions: Int[np.ndarray, " possible"], count: int, key: PRNGKeyArray) -> Positions:
    """At most `count` of the positions drawn at random, in ascending order."""
    return positions[np.sort(generator(key).permutation(len(positions))[:count])]


def evenly(positions: Int[np.ndarray, " possible"], count: int) -> Positions:
    """At most `count` of the positions, spread evenly."""
    if len(positions) <= count:
        return positions
    return positions[np.linspace(0, len(positions) - 1, count).round().astype(np.int64)]


def interleaved(first: Int[np.ndarray, " first"], second: Int[np.ndarray, " second"]) -> Int[np.ndarray, " both"]:
    """Both in one order, in which every stretch has about the same share of each."""
    place = np.concatenate([(np.arange(len(part)) + 0.5) / max(1, len(part)) for part in (first, second)])
    return np.concatenate([first, second])[np.argsort(place, kind="stable")]
