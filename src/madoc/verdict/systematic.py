"""Whether residuals are noise, or a function of the robot's state and action."""

import numpy as np
from jaxtyping import Bool, Float
from sklearn.ensemble import ExtraTreesRegressor
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import KFold, cross_val_predict
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from madoc.identification.noise import clipped

FOLDS = 5
"""Number of folds of the cross-validation."""
_FEWEST = 2 * FOLDS
"""Smallest number of rows to which regressions are fitted; with fewer, nothing counts as explained."""
_ROUNDING = 1e-6
"""Residual in typical changes of a step; a smaller one is within the tolerance of MuJoCo's solver at contacts."""

LAGS = range(4, 9)
"""Distances in rows at which residuals are compared: long enough that sensor noise, filters and differences of readings
no longer correlate."""
CERTAIN = 6.0
"""Standard errors of a correlation, from which it counts; many channels are looked at."""

EXPLAINERS = {
    "a linear function": lambda: make_pipeline(StandardScaler(), RidgeCV(np.logspace(-3, 3, 7))),
    "trees": lambda: ExtraTreesRegressor(10, min_samples_leaf=3, random_state=0),
}
"""Regressions of residuals on state and action: a linear one for smooth motion, trees for contacts."""


def explained(
    inputs: Float[np.ndarray, "rows inputs"], residuals: Float[np.ndarray, "rows observation"]
) -> tuple[float, Float[np.ndarray, "rows observation"]]:
    """The share of the squared residuals that a regression on the inputs explains, by cross-validation.

    Returns:
        The share of the better regression, at least 0 (a constant residual counts as explained), and its predictions.
    """
    total = float((residuals**2).sum())
    best, explanation = 0.0, np.zeros_like(residuals)
    wanted = residuals.ravel() if residuals.shape[1] == 1 else residuals
    if len(inputs) < _FEWEST or np.sqrt((residuals**2).mean(0)).max() <= _ROUNDING:
        return best, explanation
    for make in EXPLAINERS.values():
        guess = cross_val_predict(make(), inputs, wanted, cv=KFold(FOLDS)).reshape(residuals.shape)
        share = 1.0 - float(((residuals - guess) ** 2).sum()) / total
        if share > best:
            best, explanation = share, guess
    return best, explanation


def explained_at_end(
    inputs: Float[np.ndarray, "windows inputs"], residuals: Float[np.ndarray, "windows steps observation"]
) -> float:
    """The share of windows' squared last residuals that the inputs explain; model errors have added up in them."""
    done = np.isfinite(residuals).all((1, 2))
    return explained(inputs[done], clipped(residuals[done, -1]))[0] if done.any() else 0.0


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
