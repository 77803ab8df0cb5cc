"""Whether residuals are noise, or a function of the robot's state and action."""

from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from sklearn.ensemble import ExtraTreesRegressor
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import GroupKFold, KFold, cross_val_predict
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from threadpoolctl import threadpool_limits

from madoc.identification.noise import clipped

FOLDS = 5
"""Number of folds of the cross-validation."""
_FEWEST = 2 * FOLDS
"""Smallest number of rows to which regressions are fitted; with fewer, nothing counts as explained."""
_ROUNDING = 1e-6
"""Residual in typical changes of a stride; a smaller one is within the tolerance of MuJoCo's solver at contacts."""

EXPLAINED = 0.1
"""Share in [0, 1] of squared residuals that state and action explain on unseen rows; above it residuals are
systematic. Noise alone gives at most a few percent of many independent rows."""
REDRAWN = 39
"""Number of draws of signs with which a share explained is compared."""
BY_CHANCE = 1
"""Number of these draws that may have as large a share explained: (1 + 1) / (39 + 1) is a significance level of 5 %."""

LAGS = range(4, 9)
"""Distances in rows at which residuals are compared: long enough that sensor noise, filters and differences of readings
no longer correlate."""
CERTAIN = 6.0
"""Standard errors of a correlation, from which it counts; many channels are looked at."""

EXPLAINERS: dict[str, Callable[[], Any]] = {
    "a linear function": lambda: make_pipeline(StandardScaler(), RidgeCV(np.logspace(-3, 3, 7))),
    "trees": lambda: ExtraTreesRegressor(10, min_samples_leaf=3, random_state=0),
}
"""Regressions of residuals on state and action: a linear one for smooth motion, trees for contacts."""


Folds = list[tuple[Int[np.ndarray, " _"], Int[np.ndarray, " _"]]]
"""Rows that are learnt from and rows that are predicted, of every fold of a cross-validation."""


def explained(
    inputs: Float[np.ndarray, "rows inputs"],
    residuals: Float[np.ndarray, "rows observation"],
    folds: Folds | None = None,
) -> tuple[float, Float[np.ndarray, "rows observation"]]:
    """The share of the squared residuals that a regression on the inputs explains, by cross-validation.

    Args:
        inputs: What residuals may depend on.
        residuals: Simulated minus logged observations.
        folds: Indices of the rows of each fold that are learnt from and predicted; by default consecutive fifths are
            predicted from all others.

    Returns:
        The share of the better regression, at least 0 (a constant residual counts as explained), and its predictions.
    """
    total, best, explanation = float((residuals**2).sum()), 0.0, np.zeros_like(residuals)
    for guess in _guesses(inputs, residuals, folds):
        share = 1.0 - float(((residuals - guess) ** 2).sum()) / total
        if share > best:
            best, explanation = share, guess
    return best, explanation


def explained_each(
    inputs: Float[np.ndarray, "rows inputs"], residuals: Float[np.ndarray, "rows observation"], folds: Folds
) -> Float[np.ndarray, " observation"]:
    """The same share of every channel by itself, none of which is always 0, by the regression that explains it best."""
    shares = np.zeros(residuals.shape[1])
    for guess in _guesses(inputs, residuals, folds):
        shares = np.maximum(shares, 1.0 - ((residuals - guess) ** 2).sum(0) / (residuals**2).sum(0))
    return shares


def folds_of(groups: Int[np.ndarray, " rows"]) -> Folds:
    """Fifths of the groups, in rows: none is predicted from rows of its own group. Empty where groups are too few."""
    count = len(np.unique(groups))
    return list(GroupKFold(FOLDS).split(groups, groups=groups)) if count >= _FEWEST else []


def _guesses(
    inputs: Float[np.ndarray, "rows inputs"], residuals: Float[np.ndarray, "rows observation"], folds: Folds | None
) -> Iterator[Float[np.ndarray, "rows observation"]]:
    """What each regression predicts of residuals; nothing where there are too few, or all are rounding."""
    folds = list(KFold(FOLDS).split(inputs)) if folds is None and len(inputs) >= _FEWEST else folds or []
    enough = folds and min(len(learnt) for learnt, _ in folds) >= _FEWEST
    if not enough or np.sqrt((residuals**2).mean(0)).max(initial=0.0) <= _ROUNDING:
        return
    wanted = residuals.ravel() if residuals.shape[1] == 1 else residuals
    for make in EXPLAINERS.values():
        with threadpool_limits(1):  # the same bits on any number of cores, and no threads that wait for each other
            guess = cross_val_predict(make(), inputs, wanted, cv=folds).reshape(residuals.shape)
        yield guess


def explained_at_end(
    inputs: Float[np.ndarray, "windows inputs"],
    residuals: Float[np.ndarray, "windows steps observation"],
    rows: Int[np.ndarray, " windows"],
) -> float:
    """The share of windows' squared last residuals that the inputs explain; model errors have added up in them.

    Windows begin at the `rows`, in increasing order. Those that overlap share what forces at random did to them, which
    a regression would recognise by the state: none is predicted from windows that overlap it. A short log has few that
    do not, so by chance as well much may be explained: a share above `EXPLAINED` counts only where it is significant
    among those of residuals whose sign is drawn anew for every stretch of a window's length. That takes seven stretches
    or so: of fewer, too many draws have the signs that are there.
    """
    done, steps = np.isfinite(residuals).all((1, 2)), residuals.shape[1]
    if not done.any():
        return 0.0
    rows, last = rows[done], clipped(residuals[done, -1])
    folds = disjoint_folds(rows, steps)
    share = explained(inputs[done], last, folds)[0]
    if share <= EXPLAINED:
        return share
    random, stretch = np.random.default_rng(0), (rows - rows[0]) // steps
    signs = random.choice([-1.0, 1.0], (REDRAWN, stretch[-1] + 1))[:, stretch, None]
    as_large = (True for sign in signs if explained(inputs[done], sign * last, folds)[0] >= share)
    return share if len(list(islice(as_large, BY_CHANCE + 1))) <= BY_CHANCE else 0.0


def disjoint_folds(rows: Int[np.ndarray, " windows"], steps: int) -> Folds:
    """Consecutive fifths of windows, and for each the windows of the others that share no row with it.

    The windows begin at `rows`, in increasing order, and are `steps` rows long.
    """
    if len(rows) < _FEWEST:
        return []
    return [
        (np.flatnonzero((rows + steps <= rows[part[0]]) | (rows >= rows[part[-1]] + steps)), part)
        for _, part in KFold(FOLDS).split(rows)
    ]


def autocorrelation(
    first: Float[np.ndarray, "pairs observation"], second: Float[np.ndarray, "pairs observation"]
) -> float:
    """Correlation of residuals of consecutive steps over all signals: 0 if independent, -½ if they are sensor noise."""
    size = float(np.sqrt((first**2).sum() * (second**2).sum()))
    return 0.0 if size == 0.0 else float((first * second).sum()) / size


def persistence(residuals: Float[np.ndarray, "rows observation"], follows: Bool[np.ndarray, " rows"]) -> float:
    """Correlation of residuals of single steps with those some rows later, the largest over signals; 0 if uncertain.

    Noise of sensors and forces has none at such `LAGS`; a force that the model lacks has, if it lasts. `follows` is
    whether a row is the next one of the row before it.
    """
    run, largest = np.cumsum(~follows), 0.0
    for signal in residuals.T:
        shared = np.zeros(len(signal))
        for lag in LAGS:
            same = run[lag:] == run[:-lag]
            shared[lag:] += np.where(same, signal[lag:] * signal[:-lag], 0.0) / len(LAGS)
        size = float(np.sqrt((shared**2).sum()))
        if size > 0.0 and shared.sum() >= CERTAIN * size:
            largest = max(largest, float(shared.sum() / (signal**2).sum()))
    return largest
