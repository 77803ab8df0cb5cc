"""Windows: stretches of logged rows of one episode that can be replayed from a state rebuilt at their first row."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from madoc.data.dataset import Dataset
from madoc.errors import MadocError


@dataclass(frozen=True)
class Windows:
    """Logged stretches of equal length.

    Attributes:
        states: Simulator states at the first rows.
        actions: What was done from there.
        following: What was observed after each action.
    """

    states: Float[np.ndarray, "windows state"]
    actions: Float[np.ndarray, "windows steps action"]
    following: Float[np.ndarray, "windows steps observation"]

    def __len__(self) -> int:
        return len(self.states)

    @property
    def steps(self) -> int:
        """Control steps of each."""
        return self.actions.shape[1]


def first_rows(dataset: Dataset, rows: Int[np.ndarray, " states"], steps: int) -> Int[np.ndarray, " windows"]:
    """Which of the given rows can begin a window of `steps` rows: those whose episode goes on for as long.

    Args:
        dataset: The log.
        rows: Rows whose state can be rebuilt.
        steps: Rows of a window.

    Returns:
        Positions in `rows`.

    Raises:
        MadocError: No episode is long enough.
    """
    found = rows_that_fit(dataset, rows, steps)
    if not len(found):
        longest = int((dataset.episode_ends - dataset.episode_starts).max())
        raise MadocError(
            f"no stretch of {steps} rows begins at a state that can be rebuilt in {dataset.origin}, whose longest "
            f"episode has {longest} rows; take a horizon of 1, or data with its rows in order"
        )
    return found


def rows_that_fit(dataset: Dataset, rows: Int[np.ndarray, " states"], steps: int) -> Int[np.ndarray, " windows"]:
    """As `first_rows`; none where no episode is long enough."""
    episode = dataset.episode_of(rows)
    return np.flatnonzero(rows + steps <= dataset.episode_ends[episode])


def windows_at(
    dataset: Dataset, states: Float[np.ndarray, "windows state"], rows: Int[np.ndarray, " windows"], steps: int
) -> Windows:
    """The windows that begin at the given rows, where the robot was in the given states."""
    stretch = rows[:, None] + np.arange(steps)
    logged = dataset.transitions
    return Windows(states, np.asarray(logged.action)[stretch], np.asarray(logged.next_observation)[stretch])


def apart(dataset: Dataset, rows: Int[np.ndarray, " states"], steps: int) -> Int[np.ndarray, " windows"]:
    """Which of the given rows begin windows of `steps` rows that share no reading, as many as fit one after the other.

    A window reads `steps` + 1 observations; the one after it begins where these end.

    Args:
        dataset: The log.
        rows: Rows at which a window may begin, ascending.
        steps: Rows of a window.

    Returns:
        Positions in `rows`.

    Raises:
        MadocError: No episode is long enough.
    """
    chosen, free, episode = [], 0, -1
    possible = first_rows(dataset, rows, steps)
    episodes = dataset.episode_of(rows[possible])
    for position, row, own in zip(possible.tolist(), rows[possible].tolist(), episodes.tolist(), strict=True):
        if own != episode or row >= free:
            chosen.append(position)
            free, episode = row + steps + 1, own
    return np.array(chosen)


def readings_at(
    dataset: Dataset, rows: Int[np.ndarray, " windows"], steps: int
) -> Float[np.ndarray, "windows readings observation"]:
    """All that was observed in the windows that begin at the given rows, at their first rows too."""
    logged = dataset.transitions
    first = np.asarray(logged.observation)[rows]
    following = np.asarray(logged.next_observation)[rows[:, None] + np.arange(steps)]
    return np.concatenate([first[:, None], following], axis=1)


def evenly(positions: Int[np.ndarray, " positions"], count: int) -> Int[np.ndarray, " chosen"]:
    """At most `count` of them, spread evenly."""
    if len(positions) <= count:
        return positions
    return positions[np.linspace(0, len(positions) - 1, count).round().astype(np.int64)]
