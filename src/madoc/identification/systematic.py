"""What of residuals is no noise, but a function of the robot's state and action."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from sklearn.ensemble import ExtraTreesRegressor
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import GroupKFold, KFold, cross_val_predict
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from threadpoolctl import threadpool_limits

FOLDS = 5
"""Number of folds of the cross-validation."""
_FEWEST = 2 * FOLDS
"""Smallest number of rows to which regressions are fitted; with fewer, nothing counts as explained."""
_ROUNDING = 1e-6
"""Residual in typical changes of a stride; a smaller one is within the tolerance of MuJoCo's solver at contacts."""

EXPLAINED = 0.1
"""Share in [0, 1] of squared residuals that state and action explain on unseen rows; above it residuals are
systematic. Noise alone gives at most a few percent of many independent rows."""
EXPLAINERS: dict[str, Callable[[], Any]] = {
    "a linear function": lambda: make_pipeline(StandardScaler(), RidgeCV(np.logspace(-3, 3, 7))),
    "trees": lambda: ExtraTreesRegressor(10, min_samples_leaf=3, random_state=0),
}
"""Regressions of residuals on state and action: a linear one for smooth motion, trees for contacts."""


Folds = list[tuple[Int[np.ndarray, " _"], Int[np.ndarray, " _"]]]
"""Rows that are learnt from and rows that are predicted, of every fold of a cross-validation."""


def explained(
    inputs: Float[np.ndarray, "rows inputs"], residuals: Float[np.ndarray, "rows observation"]
) -> Float[np.ndarray, "rows observation"]:
    """What a regression on the inputs predicts of residuals, by cross-validation on consecutive fifths of the rows.

    It is the better one of those in `EXPLAINERS`, and 0 where neither leaves less than there was.
    """
    least, explanation = float((residuals**2).sum()), np.zeros_like(residuals)
    folds = list(KFold(FOLDS).split(inputs)) if len(inputs) >= _FEWEST else []
    for guess in _guesses(inputs, residuals, folds):
        left = float(((residuals - guess) ** 2).sum())
        if left < least:
            least, explanation = left, guess
    return explanation


def explained_each(
    inputs: Float[np.ndarray, "rows inputs"], residuals: Float[np.ndarray, "rows observation"], folds: Folds
) -> Float[np.ndarray, " observation"]:
    """The share in [0, 1] of squared residuals that regressions on the inputs explain on rows they have not seen.

    It is that of every channel by itself, none of which is always 0, by the regression that explains it best.
    """
    shares = np.zeros(residuals.shape[1])
    for guess in _guesses(inputs, residuals, folds):
        shares = np.maximum(shares, 1.0 - ((residuals - guess) ** 2).sum(0) / (residuals**2).sum(0))
    return shares


def folds_of(groups: Int[np.ndarray, " rows"]) -> Folds:
    """Fifths of the groups, in rows: none is predicted from rows of its own group. Empty where groups are too few."""
    count = len(np.unique(groups))
    return list(GroupKFold(FOLDS).split(groups, groups=groups)) if count >= _FEWEST else []


def _guesses(
    inputs: Float[np.ndarray, "rows inputs"], residuals: Float[np.ndarray, "rows observation"], folds: Folds
) -> Iterator[Float[np.ndarray, "rows observation"]]:
    """What each regression predicts of residuals; nothing where there are too few, or all are rounding."""
    enough = folds and min(len(learnt) for learnt, _ in folds) >= _FEWEST
    if not enough or np.sqrt((residuals**2).mean(0)).max(initial=0.0) <= _ROUNDING:
        return
    wanted = residuals.ravel() if residuals.shape[1] == 1 else residuals
    for make in EXPLAINERS.values():
        with threadpool_limits(1):  # the same bits on any number of cores, and no threads that wait for each other
            guess = cross_val_predict(make(), inputs, wanted, cv=folds).reshape(residuals.shape)
        yield guess
