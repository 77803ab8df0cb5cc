"""A last fit for prediction, where the model lacks something: from states as they were measured, over a second.

Each window's free initial state explains a part of what a wrong model gets wrong, so that the parameters that fit
windows best are not those that predict best. The errors of predictions from measured states are what a user sees, and
their minimum is what such a model is good for. Its noise is that of the measured states, so it is no better an estimate
where the model is right: it counts only where it certainly differs from the one that is best there (Hausman 1978).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.known_starts import KnownStarts
from madoc.calibration.least_squares.lengthening import FEWEST
from madoc.calibration.least_squares.plan import FIRST_DAMPING
from madoc.calibration.least_squares.search import Search, SearchState
from madoc.identification.information import Uncertainty, sandwich
from madoc.identification.windows import disjoint_windows, rows_that_fit

SECONDS = 1.0
"""Length of the predictions, the longest of those that a verdict compares besides whole runs."""
MOST, ROWS = 500, 25_000
"""Largest numbers of windows and of rows in all of them; more only for twice the fewest windows."""
BY_CHANCE = 1e-3
"""Probability with which the two estimates of a right model are told to differ."""


class MeasuredStarts(KnownStarts):
    """Windows that begin at states as they were measured, with noise; errors are those of what sensors measured."""

    @staticmethod
    def logged(
        problem: CalibrationProblem,
    ) -> tuple[Float[np.ndarray, "states state"], Int[np.ndarray, " states"]]:
        """The states as the log tells them, exactly or not, and their rows."""
        return problem.states.guesses()

    def _residuals(
        self, points: Float[np.ndarray, "searches points d"]
    ) -> Float[np.ndarray, "searches points windows values"]:
        residuals = super()._residuals(points)
        of_signals = residuals.reshape(*residuals.shape[:-1], self.windows.steps, -1)
        measured = of_signals[..., : self.problem.states.measured]
        return measured.reshape(*residuals.shape[:-1], -1)


def search_of(problem: CalibrationProblem, epochs: int, tolerance: float) -> Search:
    """The search, which begins on all windows; squares of errors count, as in the errors that a verdict tells."""
    ahead = max(1, round(SECONDS / problem.simulator.control_step))
    windows = max(2 * (FEWEST + len(problem.simulator.parameters)), min(MOST, ROWS // ahead))
    return Search(MeasuredStarts, "linear", ahead, windows, 1, windows, epochs, tolerance)


def windows_for(problem: CalibrationProblem, search: Search, key: PRNGKeyArray) -> SearchState | None:
    """The search before it has begun; None where a log does not tell where enough predictions begin.

    Nor is there one where contacts are seen: the noise of the states then decides when they begin and end.
    """
    states = problem.states
    if not states.starts_known or states.placed.any() or not len(states.rows):
        return None
    fewest = FEWEST + len(problem.simulator.parameters)
    if not len(rows_that_fit(problem.dataset, states.rows, search.horizon)):
        return None
    if len(disjoint_windows(problem.dataset, states.rows, search.horizon)) < fewest:
        return None
    state = search.init(problem, key)
    return None if state.touching.any() else state


def begun(state: SearchState, point: Float[np.ndarray, " d"]) -> SearchState:
    """The search at the estimate of the one before it."""
    return replace(state, point=point[None].copy(), damping=np.full(1, FIRST_DAMPING), refining=1)


@dataclass(frozen=True)
class Predicting:
    """An estimate that predicts better than another.

    Attributes:
        point: The estimate, in [-1, 1].
        covariance: Its covariance by what windows differ.
        shift: Its distance from the other.
    """

    point: Float[np.ndarray, " d"]
    covariance: Float[np.ndarray, "d d"]
    shift: Float[np.ndarray, " d"]

    def of_both(self, other: Uncertainty) -> Uncertainty:
        """The other's uncertainty with this one's, and with the distance of the two as an error of its own."""
        covariance = other.covariance + self.covariance + np.outer(self.shift, self.shift)
        return replace(other, covariance=covariance)


def better(state: SearchState | None, other: Float[np.ndarray, " d"]) -> Predicting | None:
    """The estimate for prediction if it is certainly not that of the search before, by Hotelling's test; else None.

    Where the model is right both estimate the same parameters, and the variance of their difference is that of the
    worse one less that of the better one (Hausman 1978), so at most that of the worse one, which this is.
    """
    from scipy.stats import f  # slow to import, and only this needs it

    if state is None or not state.epochs or state.explained < FEWEST + len(other):
        return None
    windows, count = state.explained, len(other)
    shift, covariance = state.point[0] - other, sandwich(state.bread, state.meat).covariance
    distance = float(shift @ np.linalg.pinv(covariance, hermitian=True) @ shift)
    chance = float(f.sf(distance * (windows - count) / (count * (windows - 1)), count, windows - count))
    return Predicting(state.point[0], covariance, shift) if chance < BY_CHANCE else None
