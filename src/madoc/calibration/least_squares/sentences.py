"""What least squares says of an estimate besides its numbers."""

import numpy as np

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.search import SearchState

LONG_TAILS = 1.1
"""Cost of residuals, in squared standard deviations, above which they are no normal noise.

That leaves 0.8 under Cauchy's loss, and 1 under squares.
"""
EXACT = 1e-6
"""Largest residual, in typical changes of a step, that states logged exactly leave."""
NOT_SETTLED = (
    "the search had not settled when it ended, and intervals do not count what is missing; take a larger budget"
)
STILL_LENGTHENING = "longer windows were under way when it ended: a larger budget may narrow the intervals"


def about_estimated_states(problem: CalibrationProblem, search: SearchState, horizon: int) -> str:
    """That initial states were estimated, why the data needed it, and the noise that was found."""
    if problem.states.kind != "exact":
        why = "states cannot be rebuilt from the data"
    elif problem.dataset.disturbance.velocities == "differences":
        why = "velocities are differences of positions, which are what it compares"
    elif problem.dataset.disturbance.noise:
        why = "the data is noisy"
    else:
        why = "residuals of consecutive rows speak of noise"
    sentence = f"initial states of windows of {horizon} control steps were estimated with the parameters, as {why}"
    if not search.refining:
        return sentence
    noise = 100.0 * float(np.median(search.deviation))
    return f"{sentence}; the noise it finds is {noise:.2g} % of a step's change"


def about_residuals(search: SearchState) -> tuple[str, ...]:
    """That windows were left out, or that residuals are no noise; nothing before the first steps on all windows."""
    if not (search.refining and search.epochs) or float(search.deviation.max()) < EXACT:
        return ()
    left_out, windows = len(search.rows) - search.explained, len(search.rows)
    sentence = (
        f"{left_out} of {windows} windows count for nothing: no initial state found explains them as "
        "well as others, as where contacts begin, or their simulation failed"
    )
    tails = "residuals have longer tails than noise has: the intervals are too narrow"
    return (*([sentence] if left_out else []), *([tails] if search.cost[0] > LONG_TAILS else []))


def about_model_errors(horizon: int) -> str:
    """That longer windows show what the model does wrong."""
    return (
        f"over {horizon} control steps the simulator leaves more than noise: something the model lacks, "
        "which intervals do not count"
    )
