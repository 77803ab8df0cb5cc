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
    episode = np.searchsorted(dataset.episode_starts, rows, side="right") - 1
    found = np.flatnonzero(rows + steps <= dataset.episode_ends[episode])
    if not len(found):
        longest = int((dataset.episode_ends - dataset.episode_starts).max())
        raise MadocError(
            f"no stretch of {steps} rows begins at a state that can be rebuilt in {dataset.origin}, whose longest "
            f"episode has {longest} rows; take a horizon of 1, or data with its rows in order"
        )
    return found


def windows_at(
    dataset: Dataset, states: Float[np.ndarray, "windows state"], rows: Int[np.ndarray, " windows"], steps: int
) -> Windows:
    """The windows that begin at the given rows, where the robot was in the given states."""
    stretch = rows[:, None] + np.arange(steps)
    logged = dataset.transitions
    return Windows(states, np.asarray(logged.action)[stretch], np.asarray(logged.next_observation)[stretch])
