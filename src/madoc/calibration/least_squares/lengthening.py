"""Longer windows: where a robot moves smoothly they tell more of the parameters for each reading they spend on states.

They begin where shorter ones do, whose initial states have been found, so a search on them starts near its end.
"""

from dataclasses import replace

import numpy as np

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.search import SearchState
from madoc.data import Dataset
from madoc.identification.information import half_width, sandwich
from madoc.identification.windows import disjoint_windows, evenly, rows_that_fit

LENGTHS = (1, 3, 9)
"""Windows' lengths, in those of the first."""
SHORTEST, LONGEST = 3, 20
"""Control steps of the first windows: shorter ones tell little besides their initial state, longer ones are slow."""
READINGS = 2
"""Readings of all windows of a length, over those of the first: at most, but for `FEWEST` windows."""
FEWEST = 10
"""Windows more than parameters, at least; with fewer, intervals grow by Student's t."""
AS_WELL = 1.2
"""Noise of a channel over what the first windows find: with more, model errors have grown with the windows' length."""
HOPELESS = 2.0
"""The same while still searching, from the second step on: the first begins at states that noise has moved."""
LEFT_OUT = 0.1
"""Share of windows, from 0 to 1, by which more may be left unexplained."""
CHANCE = 3.0
"""Standard errors by which white noise may seem to be correlated."""
_SMALLEST = 1e-100


def horizon_of(dataset: Dataset) -> int:
    """Control steps in which a channel changes by as much as it differs between any two rows, the median over channels.

    In shorter windows little happens; in longer ones small errors grow until simulated and logged motion have nothing
    to do with each other. Within `SHORTEST` and `LONGEST`, and no longer than the episode that the median row is in.
    """
    logged = dataset.transitions
    change = np.asarray(logged.next_observation - logged.observation).std(0)
    moving = change > 0.0
    ratio = np.median(np.asarray(logged.observation).std(0)[moving] / change[moving]) if moving.any() else 0.0
    lengths = dataset.episode_ends - dataset.episode_starts
    return min(int(np.clip(round(float(ratio)), SHORTEST, LONGEST)), int(np.median(np.repeat(lengths, lengths))))


def lengthened(problem: CalibrationProblem, shorter: SearchState, horizon: int, most: int) -> SearchState | None:
    """A search yet to begin on windows of `horizon` rows that share no reading, at rows where shorter ones begin.

    Args:
        problem: Data and simulator.
        shorter: The search before it, as it was drawn.
        horizon: Control steps of a window.
        most: Windows, but for `FEWEST`.

    Returns:
        The search, its states at their first guess; None where too few windows fit.
    """
    rows, fewest = np.sort(shorter.rows), FEWEST + shorter.unit.shape[1]
    if not len(rows_that_fit(problem.dataset, rows, horizon)):
        return None
    chosen = rows[evenly(disjoint_windows(problem.dataset, rows, horizon), max(most, fewest))]
    if len(chosen) < fewest:
        return None
    one = replace(
        shorter,
        damping=shorter.damping[:1],
        state_damping=shorter.state_damping[:1, : len(chosen)],
        cost=shorter.cost[:1],
        moved=shorter.moved[:1],
        rows=chosen,
        refining=1,
    )
    return continued(one, shorter)


def continued(longer: SearchState, shorter: SearchState) -> SearchState:
    """The longer search where the shorter one stands."""
    same = np.argsort(shorter.rows)[np.searchsorted(np.sort(shorter.rows), longer.rows)]
    return replace(longer, unit=shorter.unit[:1].copy(), states=shorter.states[:1, same].copy())


def hopeless(longer: SearchState, first: SearchState) -> bool:
    """Whether a search under way leaves so much more noise than the first that it need not go on."""
    return longer.epochs >= 2 and bool((longer.deviation > HOPELESS * first.deviation).any())


def noise_alone(longer: SearchState, first: SearchState, readings: int) -> bool:
    """Whether longer windows leave no more noise in any channel than the first did, and uncorrelated.

    Args:
        longer: A search that has settled.
        first: That on the shortest windows.
        readings: Of each of the longer windows.
    """
    quiet = bool((longer.deviation <= AS_WELL * first.deviation).all())
    return quiet and longer.autocorrelation <= CHANCE / np.sqrt(max(1, longer.explained * readings))


def tells_more(longer: SearchState, shorter: SearchState) -> bool:
    """Whether longer windows are explained as often, and leave narrower intervals, on average over parameters."""
    fewest = FEWEST + longer.unit.shape[1]
    explained, before = (search.explained / len(search.rows) for search in (longer, shorter))
    if longer.explained < fewest or explained < before - LEFT_OUT:
        return False
    widths = (half_width(sandwich(each.bread, each.meat).covariance, each.explained) for each in (longer, shorter))
    now, then = (np.log(np.maximum(width, _SMALLEST)).mean() for width in widths)
    return bool(now < then)
