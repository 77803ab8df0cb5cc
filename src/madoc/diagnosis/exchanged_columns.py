"""Columns of a log that are exchanged or reversed against the spec: the log, replayed with them put right."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
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
from madoc.simulation.response import places_of_joints

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
"""Error in typical changes of a stride, up to which the log is predicted exactly, and nothing is to be corrected."""


@dataclass(frozen=True)
class _Correction:
    """A mistake that a log may have, and what corrects it.

    Attributes:
        mistake: What may be wrong, in words.
        of_actions: Whether columns of actions are corrected, else of observations.
        order: The column that belongs in each place.
        sign: What each column is multiplied by in its new place.
    """

    mistake: str
    of_actions: bool
    order: Int[np.ndarray, " width"]
    sign: Float[np.ndarray, " width"]


def exchanged_columns(
    dataset: Dataset,
    simulator: Simulator,
    points: Float[np.ndarray, "points d"],
    steps: int,
    scale: Float[np.ndarray, " observation"],
    *,
    contradicts: bool,
) -> tuple[Finding, ...]:
    """A finding on actions or joints whose columns are exchanged or have the other sign.

    The log, whose states are logged at least approximately, and the log put right are each predicted by the best of
    the `points` in [-1, 1], over windows of so many `steps`, shorter where no episode is as long. Errors are in units
    of `scale`. `contradicts` is whether the finding says that no estimate from this log is to be trusted.
    """
    corrections = _corrections(dataset, simulator, exchanged=True)
    affordable = MOST_STEPS // (steps * len(points))
    if affordable < FEWEST_WINDOWS * len(corrections):
        corrections = _corrections(dataset, simulator, exchanged=False)
    count = min(WINDOWS, max(FEWEST_WINDOWS, affordable // max(1, len(corrections))))
    replayed = _replayed(dataset, simulator, steps, count)
    as_logged = _error(replayed, simulator, points, steps, scale, count)
    if as_logged <= _NEGLIGIBLE or not np.isfinite(as_logged):  # of a simulation that fails nothing can be told
        return ()
    better: dict[str, float] = {}
    for correction in corrections:
        error = _error(_put_right(replayed, simulator, correction), simulator, points, steps, scale, count)
        if error < BETTER * as_logged:
            better[correction.mistake] = error
    if not better:
        return ()
    least = min(better.values())
    likely = [mistake for mistake, error in better.items() if BETTER * error <= least]
    what = (
        f"{' or '.join(likely)}; put right, the log is predicted {as_logged / max(least, _NEGLIGIBLE):.2g} times better"
    )
    return (Finding("warning", what, "columns", "correct the spec or the log", contradicts=contradicts),)


def _replayed(dataset: Dataset, simulator: Simulator, steps: int, count: int) -> Dataset:
    """At most `count` windows of `steps` rows, each with the rows of its pending actions before it as an episode.

    Where no episode is as long, they are shorter. Every mistake is put right in these rows alone.
    """
    _, rows = logged_states(dataset, simulator.task)
    steps, before = longest_fit(dataset, rows, steps), simulator.task.pending
    first = rows[evenly(first_rows(dataset, rows, steps), count)]
    taken = first[:, None] + np.arange(-before, steps)
    return dataset.take(taken.ravel(), np.arange(len(first)) * taken.shape[1])


def _error(
    dataset: Dataset,
    simulator: Simulator,
    points: Float[np.ndarray, "points d"],
    steps: int,
    scale: Float[np.ndarray, " observation"],
    count: int,
) -> float:
    """The median over windows of the root mean square residual at their end, of the best point."""
    states, rows = logged_states(dataset, simulator.task)
    steps = longest_fit(dataset, rows, steps)
    chosen = evenly(first_rows(dataset, rows, steps), count)
    windows = windows_at(dataset, states[chosen], rows[chosen], steps)
    residuals = window_residuals(simulator, windows, points, scale)[..., -len(scale) :]
    sizes = np.nan_to_num(np.sqrt((residuals**2).mean(-1)), nan=np.inf)
    return float(np.median(sizes, axis=1).min())


def _corrections(dataset: Dataset, simulator: Simulator, *, exchanged: bool) -> list[_Correction]:
    """What corrects each action or joint that may be reversed and, if asked for, any two that may be exchanged.

    A correction after which the log's actions leave their range is none.
    """
    action, names = np.asarray(dataset.transitions.action, np.float64), action_names(simulator.task)
    ends = np.stack([action.min(0), action.max(0)])
    limit = _BEYOND * max(1.0, float(np.abs(ends).max(initial=0.0)))
    told = [channel.command for channel in simulator.task.actions] or [True] * len(names)
    commands = {name: [index] for index, (name, command) in enumerate(zip(names, told, strict=True)) if command}
    of_actions = _of_columns("action", commands, len(names), exchanged)
    of_joints = _of_columns("joint", _joints(simulator), simulator.task.observation_size, exchanged)
    possible = (each for each in of_actions if np.abs(_corrected_actions(ends, simulator, each)).max() <= limit)
    return [*possible, *of_joints]


def _of_columns(kind: str, columns: dict[str, list[int]], width: int, exchanged: bool) -> Iterator[_Correction]:
    """Corrections of the named actions or joints, each with its columns of `width`."""
    for name, own in columns.items():
        sign = np.ones(width)
        sign[own] = -1.0
        yield _Correction(f"the {kind} {name} has the other sign", kind == "action", np.arange(width), sign)
    if exchanged:
        for (one, first), (other, second) in combinations(columns.items(), 2):
            order = np.arange(width)
            order[[*first, *second]] = [*second, *first]
            yield _Correction(f"the {kind}s {one} and {other} are exchanged", kind == "action", order, np.ones(width))


def _put_right(dataset: Dataset, simulator: Simulator, correction: _Correction) -> Dataset:
    """The log without a mistake."""
    logged = dataset.transitions
    if correction.of_actions:
        action = _corrected_actions(np.asarray(logged.action, np.float64), simulator, correction)
        return replace(dataset, transitions=replace(logged, action=action))
    now, then = (
        np.asarray(each)[:, correction.order] * correction.sign
        for each in (logged.observation, logged.next_observation)
    )
    return replace(dataset, transitions=replace(logged, observation=now, next_observation=then))


def _corrected_actions(
    action: Float[np.ndarray, "rows action"], simulator: Simulator, correction: _Correction
) -> Float[np.ndarray, "rows action"]:
    """Actions with their columns corrected in the units of the spec, not in [-1, 1] of each column's range."""
    middle, half = simulator.task.action_ranges
    return ((action * half + middle)[:, correction.order] * correction.sign - middle) / half


def _joints(simulator: Simulator) -> dict[str, list[int]]:
    """The columns of position and velocity of each hinge or slide that has one of its own for both, by its name."""
    task = simulator.task
    if task.posture is None or task.velocities:
        return {}
    count = task.observation_size
    read = np.asarray(task.posture(np.concatenate([np.zeros((1, count)), np.eye(count)])))
    depends = np.isfinite(read[1:]) & (read[1:] != read[:1])
    found = {}
    for joint, place in places_of_joints(simulator).items():
        columns = [np.flatnonzero(depends[:, index]) for index in place]
        if all(len(each) == 1 for each in columns):
            found[joint] = [int(each[0]) for each in columns]
    return found
