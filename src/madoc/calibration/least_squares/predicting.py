"""A last fit for prediction, where the model leaves more than noise: a second ahead, from fitted states.

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
from jaxtyping import Bool, Float, Int

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.plan import FEWEST, touched
from madoc.calibration.least_squares.unknown_starts import UNLIKE_NOISE
from madoc.identification.gauss_newton import FIRST_DAMPING, TRIALS, damped_step, triangle
from madoc.identification.information import Uncertainty
from madoc.identification.linearisation import Linearisation, difference_points, linearise
from madoc.identification.replay import Readings, window_residuals
from madoc.identification.settling import ANEW, settled
from madoc.identification.windows import disjoint_windows, evenly, rows_that_fit, windows_at
from madoc.types import Epoch

Progress = Literal["not begun", "under way", "better", "no better"]
SECONDS = 1.0
"""Length of the predictions, the longest of those that a verdict compares besides whole runs."""
MOST = 200
"""Largest number of windows; an epoch of all 935 of a real arm with 24 parameters took 20 s."""
VALUES = 30_000_000
"""Largest number of simulated values of an epoch's derivatives, which bounds its memory to a few times 240 MB."""
REACH = 0.15
"""Distance in [-1, 1] from the estimate so far that counts as much as the mean error of one window."""
LEAST = 0.3
"""Smallest error of a window relative to their mean by which its squares are weighted, in (0, 1]."""
ABOVE_NOISE = 2.0
"""Error over a second relative to the sensors' noise, at least 1; up to it noise in starts and readings makes it."""
EPOCHS, ROUNDS = 10, 5
"""Largest numbers of steps until an estimate is compared with the one so far, and of estimates that take its place."""
SETTLED = 1e-3
"""Share in [0, 1] of the cost; after a step that saves less the estimates are compared."""
NARROW = (0.0,) * 6
"""Widths of the differences by initial states, a step each; motion is smooth in the windows, so they are narrow."""
FOLDS = 10
"""Number of stretches of the log, each of which is predicted by parameters that were fitted to the others."""
GAIN = 0.01
"""Share in [0, 1] of the error of prediction, the least that is worth an estimate of its own."""
MANY = 1.0 / 3.0
"""Share in [0, 1] of the windows that must be predicted better."""
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
        kept: Windows whose initial state explains the first readings; the others count for nothing.
        noise: Root mean square of the sensors' noise in typical changes; 0 where states are exact.
        first: The estimate at which it begins, in [-1, 1].
        best: The first one, or the last that predicted better than the one before.
        point: The one that moves.
        error: Mean error of the windows at the best one, in typical changes of a channel; 0 before the first step.
        damping: λ of the next step.
        covariance: Covariance of the point before the last step, by what windows differ.
        epochs: Number of steps since an estimate was compared.
        rounds: Number of estimates that predicted better.
    """

    progress: Progress
    rows: Int[np.ndarray, " windows"]
    states: Float[np.ndarray, "windows state"]
    kept: Bool[np.ndarray, " windows"]
    noise: float
    first: Float[np.ndarray, " d"]
    best: Float[np.ndarray, " d"]
    point: Float[np.ndarray, " d"]
    error: float
    damping: float
    covariance: Float[np.ndarray, "d d"]
    epochs: int = 0
    rounds: int = 0

    def of_both(self, other: Uncertainty) -> Uncertainty:
        """The other's uncertainty with this one's, and with the distance of the two as an error of its own."""
        shift = self.best - self.first
        return replace(other, covariance=other.covariance + self.covariance + np.outer(shift, shift))


def steps_of_a_second(problem: CalibrationProblem) -> int:
    """Length of the predictions in control steps."""
    return max(3, round(SECONDS / problem.simulator.control_step))


def windows_for(problem: CalibrationProblem) -> Prediction | None:
    """The fit before it has begun; None where the log has too few stretches of a second, or where a base is unknown."""
    count, horizon = len(problem.simulator.parameters), steps_of_a_second(problem)
    states, rows = problem.states.guesses()
    size = max(problem.simulator.task.observation_size, states.shape[1])
    most = min(MOST, VALUES // (horizon * size * max(1 + 2 * count, FOLDS + 1)))
    if problem.states.placed.any() or not len(rows_that_fit(problem.dataset, rows, horizon)):
        return None
    chosen = evenly(disjoint_windows(problem.dataset, rows, horizon), most)
    if len(chosen) < FEWEST + count:
        return None
    return Prediction(
        progress="not begun",
        rows=rows[chosen],
        states=states[chosen],
        kept=np.ones(len(chosen), bool),
        noise=0.0,
        first=np.zeros(count),
        best=np.zeros(count),
        point=np.zeros(count),
        error=0.0,
        damping=FIRST_DAMPING,
        covariance=np.zeros((count, count)),
    )


def begun(problem: CalibrationProblem, state: Prediction, point: Float[np.ndarray, " d"], horizon: int) -> Prediction:
    """The fit at an estimate, with initial states fitted to readings of `horizon` rows.

    With none, states are exact as logged. Windows whose readings no initial state explains, as where one of the first
    is false, begin anew, and are left out if that does not help. Where the log shows contacts the fit ends at once:
    from states with errors they begin and end at other times.
    """
    if touched(problem, state.rows, steps_of_a_second(problem)).any():
        return replace(state, progress="no better")
    at_estimate = replace(state, progress="under way", first=point, best=point, point=point)
    if not horizon:
        return at_estimate
    horizon = min(horizon, steps_of_a_second(problem))
    readings = Readings.at(problem.dataset, problem.states, state.rows, horizon, problem.typical_change)
    after = settled(problem.simulator, readings, point, state.states, NARROW, ANEW)
    kept = after.costs <= UNLIKE_NOISE
    noise = float(np.sqrt((after.deviation**2).mean()))
    return replace(at_estimate, states=after.states, kept=kept, noise=noise)


def step(problem: CalibrationProblem, state: Prediction) -> tuple[Prediction, Epoch]:
    """Take the best of some damped steps; with the last of a round, the estimate is compared with the one so far.

    Where errors are those of noise there is nothing to make up for, and the fit ends: a second may then tell a right
    model's parameters more precisely than short windows, which is no sign that it lacks something.
    """
    around = difference_points(state.point)
    residuals = _residuals(problem, state, around)
    slopes, errors = linearise(around, residuals), _errors(residuals[0])
    noise_alone = not state.rounds and not state.epochs and float(errors.mean()) <= ABOVE_NOISE * state.noise
    if noise_alone or len(slopes.residuals) < len(errors) or len(errors) < FEWEST + len(state.point):
        return replace(state, progress=_ended(state)), Epoch({}, stage="predicting")
    state = replace(state, error=state.error or float(errors.mean()))
    before = _cost(state, state.point, errors)
    steps = [_step(state, slopes, state.damping * factor) for factor in TRIALS]
    tried = _errors(_residuals(problem, state, state.point + np.stack(steps)))
    costs = [_cost(state, state.point + each, error) for each, error in zip(steps, tried, strict=True)]
    best = int(np.argmin(costs))
    helps = costs[best] < before
    over = state.epochs + 1 >= EPOCHS
    over = over or (helps and costs[best] > (1.0 - SETTLED) * before) or (not helps and state.damping > 1.0)
    state = replace(
        state,
        point=state.point + steps[best] if helps else state.point,
        damping=max(1e-10, state.damping * TRIALS[best]) if helps else 1e3 * state.damping,
        covariance=_covariance(state, slopes),
        epochs=state.epochs + 1,
    )
    if over:
        state = _compared(problem, state)
    metrics = {"residual": min(before, costs[best]), "moved": float(np.abs(steps[best]).max() * helps)}
    return state, Epoch(metrics, stage="predicting")


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
    windows = windows_at(problem.dataset, state.states[state.kept], state.rows[state.kept], steps_of_a_second(problem))
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
    return float(errors.mean()) + state.error * away


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
    near = np.sqrt(2.0 * state.error) / REACH
    rows = np.column_stack([weighted.jacobian.reshape(-1, count), weighted.residuals.reshape(-1)])
    held = np.column_stack([near * np.eye(count), near * (state.point - state.best)])
    factor = triangle(np.concatenate([rows, held]))
    return damped_step(factor[:count, :count], factor[:count, count], state.point, damping)


def _covariance(state: Prediction, slopes: Linearisation) -> Float[np.ndarray, "d d"]:
    """B⁻¹ M B⁻¹ with the curvature B of the cost and the scatter M of the windows' gradients."""
    weighted, count = _weighted(slopes), len(state.point)
    scores = np.einsum("wv,wvd->wd", weighted.residuals, weighted.jacobian)
    flat = weighted.jacobian.reshape(-1, count)
    inverse = np.linalg.pinv(flat.T @ flat + 2.0 * state.error / REACH**2 * np.eye(count), hermitian=True)
    return inverse @ (scores.T @ scores) @ inverse


def _compared(problem: CalibrationProblem, state: Prediction) -> Prediction:
    """The state once the point is compared with the best estimate so far."""
    better = _is_better(problem, state)
    if better and state.rounds + 1 < ROUNDS:
        state = replace(state, error=0.0, damping=FIRST_DAMPING, epochs=0)
    else:
        state = replace(state, progress="better" if better else _ended(state))
    return replace(state, best=state.point, rounds=state.rounds + 1) if better else state


def _ended(state: Prediction) -> Progress:
    """What a fit whose point is no better comes to: the best estimate before it."""
    return "better" if state.rounds else "no better"


def _is_better(problem: CalibrationProblem, state: Prediction) -> bool:
    """Whether the point predicts better than the best estimate so far.

    Every stretch of the log is predicted by parameters that were fitted to the others: the point moved by what leaving
    the stretch out changes of a Gauss-Newton step. A point at an end of a range is none where the best one is inside: a
    wider range would give another one.
    """
    space, around = problem.simulator.parameters, difference_points(state.point)
    outside = set(space.at_end(state.point)) - set(space.at_end(state.best))
    if outside or (state.point == state.best).all():
        return False
    residuals = _residuals(problem, state, around)
    slopes = linearise(around, residuals)
    windows = len(slopes.residuals)
    if windows < residuals.shape[1]:
        return False
    stretch, whole = np.arange(windows) * FOLDS // windows, _step(state, slopes, _LITTLE)
    without = [state.point + _step(state, slopes.of(stretch != each), _LITTLE) - whole for each in range(FOLDS)]
    errors = _errors(_residuals(problem, state, np.stack([*without, state.best]).clip(-1.0, 1.0)))
    return predicts_better(errors[stretch, np.arange(windows)], errors[-1])


def predicts_better(found: Float[np.ndarray, " windows"], before: Float[np.ndarray, " windows"]) -> bool:
    """Whether errors are smaller by a share that is worth it and by more than their standard error, not in a few alone.

    A window whose start is wrong has errors that are larger than all others' together, and then decides alone.
    """
    if not (np.isfinite(found).all() and np.isfinite(before).all()):
        return False
    gain = before - found
    sure = gain.mean() > max(GAIN * before.mean(), gain.std() / np.sqrt(len(gain)))
    return bool(sure and (gain > 0.0).mean() >= MANY)
