"""Columns of a log that are exchanged or reversed against the spec: the log, replayed with them put right."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from madoc.data import Dataset
from madoc.data.findings import Finding
from madoc.diagnosis.channels import action_names
from madoc.identification.replay import window_residuals
from madoc.identification.states import logged_states
from madoc.identification.windows import evenly, first_rows, longest_fit, windows_at
from madoc.simulation.base import Simulator
from madoc.simulation.response import single_joints

BETTER = 0.5
"""Ratio of errors; columns count as exchanged or reversed where the log put right is predicted better than that."""
WINDOWS = 64
"""Largest number of windows that are replayed."""
FEWEST_WINDOWS = 8
"""Smallest number of windows with which two columns are exchanged; where so many cost too much, none are."""
MOST_STEPS = 60_000
"""Largest number of control steps that all replays take."""
_BEYOND = 1.05
"""Largest action over the largest logged one, or over the range; sensors of current read more than the range."""
_NEGLIGIBLE = 1e-3
"""Error in typical changes of a step, up to which the log is predicted exactly."""


def exchanged_columns(
    dataset: Dataset,
    simulator: Simulator,
    points: Float[np.ndarray, "points d"],
    steps: int,
    scale: Float[np.ndarray, " observation"],
    *,
    contradicts: bool,
) -> tuple[tuple[Finding, ...], int]:
    """A finding on actions or joints whose columns are exchanged or have the other sign, and control steps simulated.

    Args:
        dataset: Rows in their order, whose states are logged at least approximately.
        simulator: The model with its calibrated parameters.
        points: Parameters in [-1, 1]; the log as it is and the log put right are each predicted by the best of them.
        steps: Length of the windows in control steps; shorter where no episode is as long.
        scale: Typical change of each signal in a step.
        contradicts: Whether the finding is to say that no estimate from this log is to be trusted.
    """
    mistakes = _mistakes(dataset, simulator, exchanged=True)
    affordable = MOST_STEPS // (steps * len(points))
    if affordable < FEWEST_WINDOWS * len(mistakes):
        mistakes = _mistakes(dataset, simulator, exchanged=False)
    count = min(WINDOWS, max(FEWEST_WINDOWS, affordable // max(1, len(mistakes))))
    as_logged, spent = _error(dataset, simulator, points, steps, scale, count)
    better: dict[str, float] = {}
    for mistake, put_right in mistakes.items():
        error, more = _error(put_right, simulator, points, steps, scale, count)
        spent += more
        if error < BETTER * as_logged:
            better[mistake] = error
    if not better:
        return (), spent
    least = min(better.values())
    likely = [mistake for mistake, error in better.items() if BETTER * error <= least]
    what = (
        f"{' or '.join(likely)}; put right, the log is predicted {as_logged / max(least, _NEGLIGIBLE):.2g} times better"
    )
    return (Finding("warning", what, "columns", "correct the spec or the log", contradicts=contradicts),), spent


def _error(
    dataset: Dataset,
    simulator: Simulator,
    points: Float[np.ndarray, "points d"],
    steps: int,
    scale: Float[np.ndarray, " observation"],
    count: int,
) -> tuple[float, int]:
    """The median over windows of the root mean square residual at their end, of the best point; control steps."""
    states, rows = logged_states(dataset, simulator.task)
    steps = longest_fit(dataset, rows, steps)
    chosen = evenly(first_rows(dataset, rows, steps), count)
    windows = windows_at(dataset, states[chosen], rows[chosen], steps)
    residuals = window_residuals(simulator, windows, points, scale)[..., -len(scale) :]
    sizes = np.nan_to_num(np.sqrt((residuals**2).mean(-1)), nan=np.inf)
    return float(np.median(sizes, axis=1).min()), len(points) * len(chosen) * steps


def _mistakes(dataset: Dataset, simulator: Simulator, *, exchanged: bool) -> dict[str, Dataset]:
    """What may be wrong, and the log without it: each action or joint reversed and, if asked for, any two exchanged.

    A log whose actions would leave their range is none.
    """
    logged, channels = dataset.transitions, simulator.task.actions
    action, names = np.asarray(logged.action, np.float64), action_names(simulator.task)
    middle = np.array([(row.high + row.low) / 2.0 for row in channels] or 0.0)
    half = np.array([(row.high - row.low) / 2.0 for row in channels] or 1.0)
    limit, found = _BEYOND * max(1.0, float(np.abs(action).max())), dict[str, Dataset]()
    of_actions = {name: [index] for index, name in enumerate(names)}
    for what, order, sign in _corrections("action", of_actions, len(names), exchanged):
        corrected = ((action * half + middle)[:, order] * sign - middle) / half
        if np.abs(corrected).max() <= limit:
            found[what] = replace(dataset, transitions=replace(logged, action=corrected))
    for what, order, sign in _corrections("joint", _joints(simulator), simulator.task.observation_size, exchanged):
        now, then = (np.asarray(each)[:, order] * sign for each in (logged.observation, logged.next_observation))
        found[what] = replace(dataset, transitions=replace(logged, observation=now, next_observation=then))
    return found


def _corrections(
    kind: str, columns: dict[str, list[int]], width: int, exchanged: bool
) -> Iterator[tuple[str, Int[np.ndarray, " width"], Float[np.ndarray, " width"]]]:
    """What may be wrong, and the order and the signs of the columns that correct it."""
    for name, own in columns.items():
        sign = np.ones(width)
        sign[own] = -1.0
        yield f"the {kind} {name} has the other sign", np.arange(width), sign
    if exchanged:
        for (one, first), (other, second) in combinations(columns.items(), 2):
            order = np.arange(width)
            order[[*first, *second]] = [*second, *first]
            yield f"the {kind}s {one} and {other} are exchanged", order, np.ones(width)


def _joints(simulator: Simulator) -> dict[str, list[int]]:
    """The columns of position and velocity of each hinge or slide that has one of its own for both, by its name."""
    task = simulator.task
    if task.posture is None or task.velocities:
        return {}
    count = task.observation_size
    read = np.asarray(task.posture(np.concatenate([np.zeros((1, count)), np.eye(count)])))
    depends = np.isfinite(read[1:]) & (read[1:] != read[:1])
    found = {}
    for joint, place in single_joints(simulator).items():
        columns = [np.flatnonzero(depends[:, index]) for index in place]
        if all(len(each) == 1 for each in columns):
            found[joint] = [int(each[0]) for each in columns]
    return found
