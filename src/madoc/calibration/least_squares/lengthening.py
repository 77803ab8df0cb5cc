"""Longer windows: where a robot moves smoothly they say more of the parameters for each reading they spend on states.

They begin where shorter ones do, whose initial states have been found, so a search on them starts near its end.
"""

from dataclasses import replace

import numpy as np

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.estimated_states import STATES_FIRST, EstimatedState
from madoc.data.windows import apart, evenly, rows_that_fit

LENGTHS = (1, 3, 9)
"""Windows' lengths, in those of the first."""
ROWS = 200
"""Of all windows of a length, in lengths of the first's: an epoch takes twice as long as one of 100 windows."""
FEWEST = 10
"""Windows more than parameters that intervals are made of; where fewer fit they grow by Student's t."""
AS_WELL = 1.2
"""Times the noise that shorter windows find in a channel: what the model does wrong grows with a window's length."""
HOPELESS = 2.0
"""Times that noise while still searching."""
LEFT_OUT = 0.1
"""Share of windows by which more may be left unexplained."""


def lengthened(problem: CalibrationProblem, shorter: EstimatedState, horizon: int, times: int) -> EstimatedState | None:
    """A search yet to begin on windows of `horizon` rows that share no reading, at rows where shorter ones begin.

    Args:
        problem: Data and simulator.
        shorter: The search before it, as it was drawn.
        horizon: Control steps of a window.
        times: How many times as long as the first's that is.

    Returns:
        The search, its states at their first guess; None where too few windows fit.
    """
    count = shorter.unit.shape[1]
    rows, fewest = np.sort(shorter.rows), FEWEST + count
    if not len(rows_that_fit(problem.dataset, rows, horizon)):
        return None
    chosen = rows[evenly(apart(problem.dataset, rows, horizon), max(ROWS // times, fewest))]
    if len(chosen) < fewest:
        return None
    known = np.searchsorted(rows, chosen)
    return replace(
        shorter,
        unit=shorter.unit[:1],
        states=shorter.states[:1, np.argsort(shorter.rows)[known]],
        damping=shorter.damping[:1],
        state_damping=shorter.state_damping[:1, known],
        cost=shorter.cost[:1],
        moved=shorter.moved[:1],
        rows=chosen,
        refining=1,
        epochs=STATES_FIRST,
    )


def begun(longer: EstimatedState, shorter: EstimatedState) -> EstimatedState:
    """The longer search where the shorter one stands."""
    same = np.argsort(shorter.rows)[np.searchsorted(np.sort(shorter.rows), longer.rows)]
    return replace(
        longer, unit=shorter.unit[:1].copy(), states=shorter.states[:1, same].copy(), deviation=shorter.deviation
    )


def explain_as_well(longer: EstimatedState, shorter: EstimatedState, times: float = AS_WELL) -> bool:
    """Whether longer windows leave no more than so many times the noise of shorter ones in every channel.

    Nor more windows unexplained.
    """
    explained, before = (search.explained / len(search.rows) for search in (longer, shorter))
    return bool((longer.deviation <= times * shorter.deviation).all()) and explained >= before - LEFT_OUT
