"""Which parameters the log could tell at all: how much a method that wastes nothing could know of each."""

import numpy as np
from jaxtyping import Float

from madoc.calibration.base import CalibrationProblem
from madoc.identification.information import BOX_VARIANCE
from madoc.identification.linearisation import DIFFERENCE, difference_points, linearise
from madoc.identification.windows import evenly
from madoc.verdict.prediction import MOST_WINDOWS

WINDOW = 20
"""Control steps that are looked at together where velocities are hidden: they are told by what follows."""
_NORMAL_95 = 1.959964
_HARDLY_TOLD = 0.25
"""Of the box's variance: the data has narrowed the direction by less than half."""
_KNOWN = 1e-9
"""Singular values of the starts' slopes, relative to the largest, below which a start changes nothing that is seen."""


def half_widths(
    problem: CalibrationProblem, unit: Float[np.ndarray, " d"], noise: Float[np.ndarray, " observation"]
) -> tuple[Float[np.ndarray, " d"], int]:
    """Half of the 95 % interval of each parameter in [-1, 1], at best, and the control steps spent.

    From slopes (Fisher's information, as if every reading's noise were its own) on top of what the box says: of single
    steps from logged states; where those cannot be rebuilt, of windows from the reset whose start is unknown.

    Args:
        problem: The rows that were calibrated to.
        unit: Where.
        noise: Deviation of what is compared, in steps' changes: of a single step, or of a reading.
    """
    states, actions = problem.probe
    if problem.simulator.task.state_from_observation is None:
        logged = np.asarray(problem.dataset.transitions.action)
        steps = min(WINDOW, len(logged))
        first = np.linspace(0, len(logged) - steps, len(states)).astype(np.int64)
        slopes, spent = _window_slopes(problem, unit, noise, states, logged[first[:, None] + np.arange(steps)])
        share = len(logged) / steps / len(states)
    else:
        rows = evenly(np.arange(len(states)), MOST_WINDOWS)
        slopes, spent = _slopes(problem, unit, noise, states[rows], actions[rows][:, None])
        share = len(problem.dataset) / max(1, len(slopes))
    flat = slopes.reshape(-1, len(unit))
    information = flat.T @ flat * share + np.eye(len(unit)) / BOX_VARIANCE
    return _NORMAL_95 * np.sqrt(np.diag(widened(np.linalg.inv(information)))), spent


def widened(covariance: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """The covariance with directions that the data hardly tells as long as the box allows.

    A direction of several parameters is longer than any of them: along it, each may go through all of its range while
    the normal distribution that stands for the box ends on a ball.
    """
    variances, directions = np.linalg.eigh(covariance)
    longest = np.abs(directions).max(0)
    variances = np.where(variances > _HARDLY_TOLD * BOX_VARIANCE, variances / longest**2, variances)
    return (directions * variances) @ directions.T


def told_shares(
    half: Float[np.ndarray, " d"], interval: Float[np.ndarray, "d 2"] | None, width: Float[np.ndarray, " d"]
) -> Float[np.ndarray, " d"]:
    """How much of each range the 95 % interval covers, at most all: the method's own, and no less than at best."""
    share = half if interval is None else np.maximum(half, (interval[:, 1] - interval[:, 0]) / width)
    return np.minimum(share, 1.0)


def _slopes(
    problem: CalibrationProblem, unit: np.ndarray, noise: np.ndarray, states: np.ndarray, actions: np.ndarray
) -> tuple[Float[np.ndarray, "windows values d"], int]:
    """How readings change with the parameters, over their noise."""
    points = difference_points(unit)
    seen = _readings(problem, points, np.broadcast_to(states, (len(points), *states.shape)), actions, noise)
    return linearise(points, seen).jacobian, len(points) * actions.shape[0] * actions.shape[1]


def _window_slopes(
    problem: CalibrationProblem, unit: np.ndarray, noise: np.ndarray, states: np.ndarray, actions: np.ndarray
) -> tuple[Float[np.ndarray, "windows values d"], int]:
    """The same, without what a change of the start would do as well."""
    slopes, spent = _slopes(problem, unit, noise, states, actions)
    moves = np.concatenate([np.zeros((1, states.shape[1])), DIFFERENCE * np.eye(states.shape[1])])
    moved = states + moves[:, None]
    seen = _readings(problem, np.repeat(unit[None], len(moves), axis=0), moved, actions, noise)
    whole = np.isfinite(seen).all((0, 2))
    if len(slopes) != len(states) or not whole.all():
        return slopes, spent
    starts = np.moveaxis(seen[1:] - seen[0], 0, -1) / DIFFERENCE
    left, size, _ = np.linalg.svd(starts, full_matrices=False)
    left = left * (size > _KNOWN * np.maximum(size[:, :1], 1e-300))[:, None]
    return slopes - left @ (np.swapaxes(left, 1, 2) @ slopes), spent + len(moves) * actions.shape[0] * actions.shape[1]


def _readings(
    problem: CalibrationProblem, points: np.ndarray, states: np.ndarray, actions: np.ndarray, noise: np.ndarray
) -> Float[np.ndarray, "points windows values"]:
    """What is seen after every action of the windows, one system a point, over the noise."""
    simulator, scale = problem.simulator, problem.scalings["standardised"].next_scale
    system = simulator.bind(simulator.parameters.to_physical(points))
    state, columns = system.unbiased(np.ascontiguousarray(states)), []
    for step in range(actions.shape[1]):
        action = np.ascontiguousarray(np.broadcast_to(actions[:, step], (len(points), *actions[:, step].shape)))
        state = system.step(state, action)
        columns.append(system.observe(state) / (scale * noise))
    return np.concatenate(columns, axis=-1)
