"""Longer windows: where a robot moves smoothly they say more of the parameters for each reading they spend on states.

They begin where shorter ones do, whose initial states have been found, so a search on them starts near its end.
"""

from dataclasses import replace

import numpy as np

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.estimated_states import STATES_FIRST, EstimatedState
from madoc.identification.information import half_width, sandwich
from madoc.identification.windows import disjoint_windows, evenly, rows_that_fit

LENGTHS = (1, 3, 9)
"""Windows' lengths, in those of the first."""
READINGS = 2
"""Of all windows of a length, at most so many times the first's."""
FEWEST = 10
"""Windows more than parameters that intervals are made of; where fewer fit they grow by Student's t."""
AS_WELL = 1.2
"""Times the noise that the first windows find in a channel: what the model does wrong grows with a window's length."""
HOPELESS = 2.0
"""Times that noise while still searching, from the second step on: the first begins at states that noise has moved."""
LEFT_OUT = 0.1
"""Share of windows by which more may be left unexplained."""
CHANCE = 3.0
"""Standard deviations by which white noise may seem to be correlated."""
_SMALLEST = 1e-100


def lengthened(problem: CalibrationProblem, shorter: EstimatedState, horizon: int, most: int) -> EstimatedState | None:
    """A search yet to begin on windows of `horizon` rows that share no reading, at rows where shorter ones begin.

    Args:
        problem: Data and simulator.
        shorter: The search before it, as it was drawn.
        horizon: Control steps of a window.
        most: Windows, but for `FEWEST`.

    Returns:
        The search, its states at their first guess; None where too few windows fit.
    """
    count = shorter.unit.shape[1]
    rows, fewest = np.sort(shorter.rows), FEWEST + count
    if not len(rows_that_fit(problem.dataset, rows, horizon)):
        return None
    chosen = rows[evenly(disjoint_windows(problem.dataset, rows, horizon), max(most, fewest))]
    if len(chosen) < fewest:
        return None
    known = np.searchsorted(rows, chosen)
    return replace(
        shorter,
        unit=shorter.unit[:1],
        states=shorter.states[:1, np.argsort(shorter.rows)[known]],
        damping=shorter.damping[:1],
        state_damping=shorter.state_damping[:1, : len(chosen)],
        cost=shorter.cost[:1],
        moved=shorter.moved[:1],
        rows=chosen,
        refining=1,
        epochs=STATES_FIRST,
    )


def begun(longer: EstimatedState, shorter: EstimatedState) -> EstimatedState:
    """The longer search where the shorter one stands."""
    same = np.argsort(shorter.rows)[np.searchsorted(np.sort(shorter.rows), longer.rows)]
    return replace(longer, unit=shorter.unit[:1].copy(), states=shorter.states[:1, same].copy())


def hopeless(longer: EstimatedState, first: EstimatedState) -> bool:
    """Whether a search that is under way leaves so much more noise than the first that it need not go on."""
    told = longer.epochs >= STATES_FIRST + 2
    return told and bool((longer.deviation > HOPELESS * first.deviation).any())


def noise_alone(longer: EstimatedState, first: EstimatedState, readings: int) -> bool:
    """Whether longer windows leave no more noise in any channel than the first did, and uncorrelated.

    Args:
        longer: A search that has settled.
        first: That on the shortest windows.
        readings: Of each of the longer windows.
    """
    quiet = bool((longer.deviation <= AS_WELL * first.deviation).all())
    return quiet and longer.echo <= CHANCE / np.sqrt(max(1, longer.explained * readings))


def says_more(longer: EstimatedState, shorter: EstimatedState) -> bool:
    """Whether longer windows are explained as often, and leave narrower intervals, on average over parameters."""
    fewest = FEWEST + longer.unit.shape[1]
    explained, before = (search.explained / len(search.rows) for search in (longer, shorter))
    if longer.explained < fewest or explained < before - LEFT_OUT:
        return False
    widths = (half_width(sandwich(each.bread, each.meat).covariance, each.explained) for each in (longer, shorter))
    now, then = (np.log(np.maximum(width, _SMALLEST)).mean() for width in widths)
    return bool(now < then)
