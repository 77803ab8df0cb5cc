"""A last fit for prediction, where the model leaves more than noise: a second ahead, from states that windows fitted.

Each window's free initial state explains a part of what a wrong model gets wrong, so that the parameters that fit
short windows best are not those that predict best. Here initial states are held where the readings after them put them,
and parameters alone explain the second that follows, as in the predictions that a verdict tells of. What is minimised
is the mean of the windows' errors, of which a few that go wrong are a small part, and a term that keeps parameters near
the estimate so far, θ₁, where windows hardly tell them:

    mean_w √(mean_t r²) + e ‖θ - θ₁‖² / (n l²), with e the mean error at θ₁, n windows and a reach l.

Steps are Gauss-Newton's on squares weighted by each window's error at the last point, which bound it from above (Hunter
and Lange 2004). If the model is right, such an estimate has more noise and no advantage, so it counts only where it
predicts better than θ₁ in windows that it was not fitted to; it then takes the place of θ₁, for as long as that is so.
"""

from dataclasses import dataclass, replace
from typing import Literal

import jax
import numpy as np
from jaxtyping import Float, Int

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.plan import FEWEST, FIRST_DAMPING, TRIALS
from madoc.calibration.least_squares.statistics import touched
from madoc.identification import settling
from madoc.identification.gauss_newton import damped_step, triangle
from madoc.identification.information import Uncertainty
from madoc.identification.linearisation import Linearisation, difference_points, linearise
from madoc.identification.replay import Readings, window_residuals
from madoc.identification.windows import disjoint_windows, evenly, rows_that_fit, windows_at
from madoc.types import Epoch

Progress = Literal["not begun", "under way", "better", "no better"]
SECONDS = 1.0
"""Length of the predictions, the longest of those that a verdict compares besides whole runs."""
VALUES = 30_000_000
"""Largest number of simulated values of an epoch's derivatives, which bounds its memory to a few times 240 MB."""
REACH = 0.15
"""Distance in [-1, 1] from the estimate so far that counts as much as the mean error of one window."""
LEAST = 0.3
"""Smallest error of a window relative to their mean by which its squares are weighted, in (0, 1]."""
EPOCHS, ROUNDS = 10, 5
"""Largest numbers of steps until an estimate is compared with the one so far, and of estimates that take its place."""
SETTLED = 1e-3
"""Share in [0, 1] of the cost; after a step that saves less the estimates are compared."""
STEPS = 6
"""Number of damped steps of an initial state, which begins where the log says."""
FOLDS = 10
"""Number of stretches of the log, each of which is predicted by parameters that were fitted to the others."""
GAIN = 0.01
"""Share in [0, 1] of the error of prediction, the least that is worth an estimate of its own."""
_LITTLE = 1e-6
"""Relative damping of the step that leaves a stretch out."""
_SMALLEST = 1e-100


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Prediction:
    """The state of the fit.

    Attributes:
        progress: How far it is: `not begun`, `under way`, or ended with an estimate that is `better` or `no better`.
        rows: First rows of the windows.
        states: Their initial states, held once the fit has begun.
        first: The estimate at which it begins, in [-1, 1].
        best: The first one, or the last that predicted better than the one before.
        point: The one that moves.
        scale: Mean error of the windows at the best one, in typical changes of a channel; 0 before the first step.
        cost: Mean error at the point and the term that keeps it near the best one.
        damping: λ of the next step.
        covariance: Covariance of the point by what windows differ.
        epochs: Number of steps since an estimate was compared.
        rounds: Number of estimates that predicted better.
    """

    progress: Progress
    rows: Int[np.ndarray, " windows"]
    states: Float[np.ndarray, "windows state"]
    first: Float[np.ndarray, " d"]
    best: Float[np.ndarray, " d"]
    point: Float[np.ndarray, " d"]
    scale: float
    cost: float
    damping: float
    covariance: Float[np.ndarray, "d d"]
    epochs: int
    rounds: int

    def of_both(self, other: Uncertainty) -> Uncertainty:
        """The other's uncertainty with this one's, and with the distance of the two as an error of its own."""
        shift = self.best - self.first
        return replace(other, covariance=other.covariance + self.covariance + np.outer(shift, shift))


def horizon_of(problem: CalibrationProblem) -> int:
    """Length of the predictions in control steps."""
    return max(3, round(SECONDS / problem.simulator.control_step))


def windows_for(problem: CalibrationProblem) -> Prediction | None:
    """The fit before it has begun; None where the log has too few stretches of a second, or where a base is unknown."""
    count, horizon = len(problem.simulator.parameters), horizon_of(problem)
    states, rows = problem.states.guesses()
    most = VALUES // (horizon * problem.simulator.task.observation_size * (1 + 2 * count))
    if problem.states.placed.any() or not len(rows_that_fit(problem.dataset, rows, horizon)):
        return None
    chosen = evenly(disjoint_windows(problem.dataset, rows, horizon), most)
    if len(chosen) < FEWEST + count:
        return None
    return Prediction(
        progress="not begun",
        rows=rows[chosen],
        states=states[chosen],
        first=np.zeros(count),
        best=np.zeros(count),
        point=np.zeros(count),
        scale=0.0,
        cost=0.0,
        damping=FIRST_DAMPING,
        covariance=np.zeros((count, count)),
        epochs=0,
        rounds=0,
    )


def begun(
    problem: CalibrationProblem, state: Prediction, point: Float[np.ndarray, " d"], horizon: int
) -> tuple[Prediction, int]:
    """The fit at an estimate, and the control steps simulated to fit initial states to readings of `horizon` rows.

    With none, states are exact as logged. Where the log shows contacts it ends at once: from states with errors they
    begin and end at other times.
    """
    if touched(problem, *problem.states.guesses(), state.rows, horizon_of(problem)).any():
        return replace(state, progress="no better"), 0
    states, simulations = state.states, 0
    if horizon:
        readings = Readings.at(problem.dataset, problem.states, state.rows, horizon, problem.typical_change)
        damping, narrow = np.full(len(states), settling.FIRST_DAMPING), np.zeros(len(readings.spread))
        for _ in range(STEPS):
            after = settling.settle(problem.simulator, readings, point, states, damping, narrow, "cauchy")
            states, damping, simulations = after.states, after.damping, simulations + after.simulations
    at_estimate = replace(state, progress="under way", states=states, first=point, best=point, point=point)
    return at_estimate, simulations * horizon


def step(problem: CalibrationProblem, state: Prediction) -> tuple[Prediction, Epoch]:
    """Take the best of some damped steps; with the last of a round, the estimate is compared with the one so far."""
    around = difference_points(state.point)
    residuals = _residuals(problem, state, around)
    slopes, errors = linearise(around, residuals), _errors(residuals[0])
    scale = state.scale or float(errors[np.isfinite(errors)].mean())
    state = replace(state, scale=scale)
    before = _cost(state, state.point, errors)
    steps = [_step(state, slopes, state.damping * factor) for factor in TRIALS]
    tried = _errors(_residuals(problem, state, state.point + np.stack(steps)))
    costs = [_cost(state, state.point + each, error) for each, error in zip(steps, tried, strict=True)]
    best = int(np.argmin(costs))
    helps = costs[best] < before
    spent = (len(around) + len(steps)) * len(state.rows) * horizon_of(problem)
    over = state.epochs + 1 >= EPOCHS or not np.isfinite(before)
    over = over or (helps and costs[best] > (1.0 - SETTLED) * before) or (not helps and state.damping > 1.0)
    state = replace(
        state,
        point=state.point + steps[best] if helps else state.point,
        cost=costs[best] if helps else min(before, 1.0 / _SMALLEST),
        damping=max(1e-10, state.damping * TRIALS[best]) if helps else 1e3 * state.damping,
        covariance=_covariance(state, slopes),
        epochs=state.epochs + 1,
    )
    if over:
        state, more = _compared(problem, state)
        spent += more
    metrics = {"residual": min(before, state.cost), "moved": float(np.abs(steps[best]).max() * helps)}
    return state, Epoch(metrics, spent, stage="predicting")


def medians_of_three(
    values: Float[np.ndarray, "*windows readings channels"],
) -> Float[np.ndarray, "*windows fewer channels"]:
    """The median of each value, the one before and the one after it; there is none at the ends.

    What a model gets wrong differs little from one reading to the next, but a false reading stands alone.
    """
    before, here, after = values[..., :-2, :], values[..., 1:-1, :], values[..., 2:, :]
    return np.maximum(np.minimum(before, here), np.minimum(np.maximum(before, here), after))


def _residuals(
    problem: CalibrationProblem, state: Prediction, points: Float[np.ndarray, "points d"]
) -> Float[np.ndarray, "points windows values"]:
    """Medians of three residuals in typical changes of what is measured; NaN in windows whose simulation failed."""
    windows = windows_at(problem.dataset, state.states, state.rows, horizon_of(problem))
    residuals = window_residuals(problem.simulator, windows, points, problem.typical_change)
    of_channels = residuals.reshape(*residuals.shape[:2], windows.steps, -1)[..., : problem.states.measured]
    return medians_of_three(of_channels).reshape(*residuals.shape[:2], -1)


def _errors(residuals: Float[np.ndarray, "*windows values"]) -> Float[np.ndarray, "*windows"]:
    """Root mean square of each window's residuals; infinite where its simulation failed."""
    with np.errstate(over="ignore", invalid="ignore"):
        size = np.sqrt((residuals**2).mean(-1))
    return np.where(np.isfinite(size), size, np.inf)


def _cost(state: Prediction, point: Float[np.ndarray, " d"], errors: Float[np.ndarray, " windows"]) -> float:
    """The mean error and the term that keeps the point near the best one; infinite if any simulation failed."""
    away = float(((point - state.best) ** 2).sum()) / (len(errors) * REACH**2)
    return float(errors.mean()) + state.scale * away


def _weighted(slopes: Linearisation) -> Linearisation:
    """Residuals and derivatives whose squares sum up to the windows' errors, with a mean of squares in each window."""
    errors = _errors(slopes.residuals)
    root = (np.maximum(errors, LEAST * errors.mean() + _SMALLEST) * slopes.residuals.shape[1]) ** -0.5
    return Linearisation(slopes.residuals * root[:, None], slopes.jacobian * root[:, None, None])


def _step(state: Prediction, slopes: Linearisation, damping: float) -> Float[np.ndarray, " d"]:
    """The damped Gauss-Newton step of the weighted squares and the term that keeps the point near the best one.

    That an error is half of the squares that bound it gives the latter its factor of 2.
    """
    weighted, count = _weighted(slopes), len(state.point)
    near = np.sqrt(2.0 * state.scale) / REACH
    rows = np.column_stack([weighted.jacobian.reshape(-1, count), weighted.residuals.reshape(-1)])
    held = np.column_stack([near * np.eye(count), near * (state.point - state.best)])
    factor = triangle(np.concatenate([rows, held]))
    return damped_step(factor[:count, :count], factor[:count, count], state.point, damping)


def _covariance(state: Prediction, slopes: Linearisation) -> Float[np.ndarray, "d d"]:
    """B⁻¹ M B⁻¹ with the curvature B of the cost and the scatter M of the windows' gradients."""
    weighted, count = _weighted(slopes), len(state.point)
    scores = np.einsum("wv,wvd->wd", weighted.residuals, weighted.jacobian)
    flat = weighted.jacobian.reshape(-1, count)
    inverse = np.linalg.pinv(flat.T @ flat + 2.0 * state.scale / REACH**2 * np.eye(count), hermitian=True)
    return inverse @ (scores.T @ scores) @ inverse


def _compared(problem: CalibrationProblem, state: Prediction) -> tuple[Prediction, int]:
    """The state once the point is compared with the best estimate so far, and the control steps simulated."""
    better, spent = _is_better(problem, state)
    if better and state.rounds + 1 < ROUNDS:
        state = replace(state, scale=0.0, damping=FIRST_DAMPING, epochs=0)
    else:
        state = replace(state, progress="better" if better or state.rounds else "no better")
    return replace(state, best=state.point, rounds=state.rounds + 1) if better else state, spent


def _is_better(problem: CalibrationProblem, state: Prediction) -> tuple[bool, int]:
    """Whether the point predicts better than the best estimate so far, and the control steps simulated.

    Every stretch of the log is predicted by parameters that were fitted to the others, by one Gauss-Newton step from
    those fitted to all. A point at an end of a range is none where the best one is inside: a wider range would give
    another one.
    """
    space, around = problem.simulator.parameters, difference_points(state.point)
    if set(space.at_end(state.point)) - set(space.at_end(state.best)):
        return False, 0
    residuals = _residuals(problem, state, around)
    whole = np.isfinite(residuals).all((0, 2))
    slopes, stretch = linearise(around, residuals), np.arange(int(whole.sum())) * FOLDS // max(1, int(whole.sum()))
    without = [state.point + _step(state, slopes.of(stretch != each), _LITTLE) for each in np.unique(stretch)]
    errors = _errors(_residuals(problem, state, np.stack([*without, state.best])))[:, whole]
    found = errors[stretch, np.arange(len(stretch))]
    spent = (len(around) + len(errors)) * len(state.rows) * horizon_of(problem)
    enough = len(stretch) >= FEWEST + len(space)
    return enough and bool(found.mean() <= (1.0 - GAIN) * errors[-1].mean()), spent
