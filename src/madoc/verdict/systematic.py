"""Are residuals noise, or do they follow from where the robot was and what it did?"""

import numpy as np
from jaxtyping import Float
from sklearn.ensemble import ExtraTreesRegressor
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import KFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

FOLDS = 5
_FEWEST = 2 * FOLDS

EXPLAINERS = {
    "a linear function": lambda: make_pipeline(StandardScaler(), RidgeCV(np.logspace(-3, 3, 7))),
    "trees": lambda: ExtraTreesRegressor(10, min_samples_leaf=3, random_state=0),
}
"""What tries to say a residual from state and action: motion in the large, and contacts."""


def explained(
    pairs: Float[np.ndarray, "rows pair"], residuals: Float[np.ndarray, "rows observation"]
) -> tuple[float, Float[np.ndarray, "rows observation"]]:
    """The share of the squared residuals that observation and action say, on rows the explainer has not seen.

    Returns:
        The share of the better explainer, at least 0 (a constant residual is said, too), and what it says.
    """
    total = float((residuals**2).sum())
    best, said = 0.0, np.zeros_like(residuals)
    wanted = residuals.ravel() if residuals.shape[1] == 1 else residuals
    if len(pairs) < _FEWEST or total == 0.0:
        return best, said
    for make in EXPLAINERS.values():
        guess = np.empty_like(residuals)
        for seen, unseen in KFold(FOLDS).split(pairs):
            model = make().fit(pairs[seen], wanted[seen])
            guess[unseen] = np.reshape(model.predict(pairs[unseen]), (len(unseen), -1))
        share = 1.0 - float(((residuals - guess) ** 2).sum()) / total
        if share > best:
            best, said = share, guess
    return best, said


def autocorrelation(
    first: Float[np.ndarray, "pairs observation"], second: Float[np.ndarray, "pairs observation"]
) -> float:
    """Of residuals of steps that follow each other, all signals together: 0 if independent, -½ of pure sensor noise."""
    size = float(np.sqrt((first**2).sum() * (second**2).sum()))
    return 0.0 if size == 0.0 else float((first * second).sum()) / size
