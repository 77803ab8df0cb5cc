"""Windows that tell much of some parameter, which a log with contacts may have few of.

A ball that bounces a few times and then lies still tells of its bounces in a few windows of hundreds. Of those drawn by
chance, too few are of these, and what they would tell passes for windows that no initial state explains.
"""

import numpy as np
from jaxtyping import Float, Int

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.statistics import touched
from madoc.identification.linearisation import WIDE
from madoc.identification.replay import Readings

COMPARED = 6
"""Number of windows that are compared for each that is drawn; comparing all of a long log would take too long."""


def telling_first(
    problem: CalibrationProblem,
    rows: Int[np.ndarray, " windows"],
    horizon: int,
    drawn: int,
    searched: int,
    first: Int[np.ndarray, " some"] | None = None,
) -> Int[np.ndarray, " windows"]:
    """Rows of windows in random order, of which every other of those `searched` first is one that tells most.

    The others remain random: windows that tell much are also those whose initial states are hardest to find. Nothing
    changes where as many are `drawn` as there are, or where the log shows no contact. Those that come `first` are not
    chosen anew where they are given.
    """
    if first is not None:
        return np.concatenate([first, rows[~np.isin(rows, first)]])
    compared = rows[: COMPARED * drawn]
    if drawn >= len(rows) or not touched(problem, *problem.states.guesses(), compared, horizon).any():
        return rows
    telling = compared[np.argsort(-_shares(problem, compared, horizon), kind="stable")[: min(drawn, searched) // 2]]
    others = rows[~np.isin(rows, telling)]
    pairs = np.stack([telling, others[: len(telling)]], axis=1)
    return np.concatenate([pairs.ravel(), others[len(telling) :]])


def _shares(
    problem: CalibrationProblem, rows: Int[np.ndarray, " windows"], horizon: int
) -> Float[np.ndarray, " windows"]:
    """How much of all that the windows tell of the parameters each of them does, as the sum over all directions.

    This is the leverage of a linear regression, by differences from mid-range that are wide enough to show beside the
    jumps of contacts. It takes windows · (1 + d) · horizon control steps.
    """
    readings = Readings.at(problem.dataset, problem.states, rows, horizon, problem.typical_change)
    guesses = problem.states.states[np.searchsorted(problem.states.rows, rows)]
    count = len(problem.simulator.parameters)
    points = np.concatenate([np.zeros((1, count)), WIDE * np.eye(count)])
    seen = readings.residuals(problem.simulator, points, np.repeat(guesses[None], len(points), axis=0))[:, 0]
    with np.errstate(invalid="ignore"):
        changes = np.moveaxis(seen[1:] - seen[0], 0, -1)
    changes = np.where(np.isfinite(changes).all((1, 2), keepdims=True), changes, 0.0)
    told = np.einsum("wvd,wve->wde", changes, changes)
    return np.einsum("wde,ed->w", told, np.linalg.pinv(told.sum(0), hermitian=True))
