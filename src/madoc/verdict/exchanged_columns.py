"""Columns of a log that are exchanged or reversed against the spec: the hold-out, replayed with them put right."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Float

from madoc.data import Dataset
from madoc.diagnosis.channels import action_names
from madoc.identification.replay import window_residuals
from madoc.identification.states import logged_states
from madoc.identification.windows import evenly, first_rows, longest_fit, windows_at
from madoc.simulation.base import Simulator
from madoc.simulation.response import single_joints

BETTER = 0.5
"""Ratio of errors; columns are exchanged or reversed where the log put right is predicted better than that."""
WINDOWS = 64
"""Largest number of windows that are replayed."""


def exchanged_columns(
    held_out: Dataset,
    simulator: Simulator,
    points: Float[np.ndarray, "points d"],
    steps: int,
    scale: Float[np.ndarray, " observation"],
) -> tuple[tuple[str, ...], int]:
    """Sentences on actions or joints whose columns are exchanged or have the other sign, and control steps simulated.

    Args:
        held_out: Rows in their order, whose states are logged at least approximately.
        simulator: The model with its calibrated parameters.
        points: Parameters in [-1, 1]; the log as it is and the log put right are each predicted by the best of them.
        steps: Length of the windows in control steps; shorter where no episode is as long.
        scale: Typical change of each signal in a step.
    """
    as_logged, spent = _error(held_out, simulator, points, steps, scale)
    errors: dict[str, float] = {}
    for sentence, put_right in _put_right(held_out, simulator):
        errors[sentence], more = _error(put_right, simulator, points, steps, scale)
        spent += more
    better = {sentence: error for sentence, error in errors.items() if error < BETTER * as_logged}
    if not better:
        return (), spent
    least = min(better.values())
    likely = [sentence for sentence, error in better.items() if BETTER * error <= least]
    gained = f"with that put right it is predicted {as_logged / max(least, np.finfo(float).tiny):.2g} times better"
    return (f"{' or '.join(likely)}: {gained}",), spent


def _error(
    dataset: Dataset,
    simulator: Simulator,
    points: Float[np.ndarray, "points d"],
    steps: int,
    scale: Float[np.ndarray, " observation"],
) -> tuple[float, int]:
    """The median over windows of the root mean square residual at their end, of the best point; control steps."""
    states, rows = logged_states(dataset, simulator.task)
    steps = longest_fit(dataset, rows, steps)
    chosen = evenly(first_rows(dataset, rows, steps), WINDOWS)
    windows = windows_at(dataset, states[chosen], rows[chosen], steps)
    residuals = window_residuals(simulator, windows, points, scale)[..., -len(scale) :]
    sizes = np.nan_to_num(np.sqrt((residuals**2).mean(-1)), nan=np.inf)
    return float(np.median(sizes, axis=1).min()), len(points) * len(chosen) * steps


def _put_right(dataset: Dataset, simulator: Simulator) -> Iterator[tuple[str, Dataset]]:
    """What may be wrong, and the log without it."""
    logged, names = dataset.transitions, action_names(simulator.task)
    for sentence, order, sign in _mistakes("the action", [(name, [index]) for index, name in enumerate(names)]):
        action = _moved(np.asarray(logged.action), order, sign)
        yield sentence, replace(dataset, transitions=replace(logged, action=action))
    for sentence, order, sign in _mistakes("the joint", _joints(simulator)):
        now, then = (_moved(np.asarray(each), order, sign) for each in (logged.observation, logged.next_observation))
        yield sentence, replace(dataset, transitions=replace(logged, observation=now, next_observation=then))


def _mistakes(
    what: str, columns: list[tuple[str, list[int]]]
) -> Iterator[tuple[str, dict[int, int], dict[int, float]]]:
    """Every reversal of one, and every exchange of two: the column that takes each one's place, and each one's sign."""
    for name, own in columns:
        yield f"{what} {name} has the other sign", {}, dict.fromkeys(own, -1.0)
    for (one, first), (other, second) in combinations(columns, 2):
        if len(first) == len(second):
            order = dict(zip([*first, *second], [*second, *first], strict=True))
            yield f"{what}s {one} and {other} are exchanged", order, {}


def _moved(table: np.ndarray, order: dict[int, int], sign: dict[int, float]) -> np.ndarray:
    """The table with some columns in another order or of another sign."""
    place = np.array([order.get(index, index) for index in range(table.shape[1])])
    return table[:, place] * np.array([sign.get(index, 1.0) for index in range(table.shape[1])], table.dtype)


def _joints(simulator: Simulator) -> list[tuple[str, list[int]]]:
    """Each hinge or slide whose position and velocity are signals of their own, and the columns of these."""
    task = simulator.task
    if task.posture is None or task.velocities:
        return []
    count = task.observation_size
    read = np.asarray(task.posture(np.concatenate([np.zeros((1, count)), np.eye(count)])))
    depends = np.isfinite(read[1:]) & (read[1:] != read[:1])
    found = []
    for joint, place in single_joints(simulator).items():
        columns = [np.flatnonzero(depends[:, index]) for index in place]
        if all(len(each) == 1 for each in columns):
            found.append((joint, [int(each[0]) for each in columns]))
    return found
