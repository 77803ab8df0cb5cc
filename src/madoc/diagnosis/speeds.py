"""Positions and speeds of a log compared: units, signs, wrapped angles, the rate of rows, speeds that come late."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import median_filter
from scipy.stats import median_abs_deviation

from madoc.data import Dataset
from madoc.data.findings import Finding
from madoc.simulation.base import Simulator
from madoc.tasks import Task

SAME_RATE = 0.02
"""Difference from 1 of a position's change over that by its speed, and change of that ratio over a run; beyond it is
told."""
LATE = 0.75
"""Lag of a speed in control steps; a larger one is told. That of differences of successive positions is 0.5."""
STRETCH = 0.1
"""s; positions and speeds are compared over stretches of this length, over which noise averages out."""
CERTAIN = 5.0
"""Standard errors by which a ratio or a lag has to differ before it is told."""
_UNIT_ERRORS = {
    180.0 / np.pi: "one in degrees, the other in radians",
    1000.0: "one in thousandths (mm, ms) of the other",
    100.0: "one in cm, the other in m",
    2.0 * np.pi: "one in turns, the other in radians",
    30.0 / np.pi: "a speed in rpm",
    -1.0: "one of them with its sign reversed",
}
"""Mistakes by the ratio, or its inverse, of a position's changes to those that its speed implies."""
_TRUSTED = 0.5
"""Squared correlation in [0, 1] of a position's changes with its speed; below it their ratio is not judged."""
_EXPLAINED = 0.99
"""Share in [0, 1] of the variance of a position's changes that its speed explains; below it, as where something hits
the floor between two rows, small differences are not judged."""
_NEAR = (0.8, 1.25)
"""Ratios that are no mistake of a unit."""
JUMP = 8.0
"""Distance of a change of speed from its neighbours', in standard deviations of that by the median absolute deviation,
from which it is taken for an impact: in such a row the mean of two speeds is not that between them."""
_STEPS = 3.0
"""Smallest distance from its neighbours of a change of speed that counts as an impact, in median changes of the log."""
_NEIGHBOURS = 5
"""Number of rows, the row itself among them, that are neighbours."""
_BLOCKS = 12
"""Number of parts of the log that are left out, one at a time, for standard errors."""
_FEWEST = 36
"""Number of stretches; with fewer, small differences are not looked for."""


@dataclass(frozen=True)
class _Pair:
    """A joint whose position and speed are both logged.

    Attributes:
        position: Name of the signal of the position.
        speed: Name of the signal of the speed.
        change: Change of the position in each row, rad or m.
        expected: That change by the speed: the mean of its two readings times the control step.
        places: The place of each row in its episode, from -0.5 to 0.5.
        starts: Rows at which an episode begins.
        hit: Whether the speed jumps between two rows, as where something hits the floor.
    """

    position: str
    speed: str
    change: Float[np.ndarray, " rows"]
    expected: Float[np.ndarray, " rows"]
    places: Float[np.ndarray, " rows"]
    starts: Int[np.ndarray, " episodes"]
    hit: Bool[np.ndarray, " rows"]


def speed_findings(dataset: Dataset, simulator: Simulator) -> tuple[list[Finding], bool]:
    """Findings on positions that do not change by speed times control step, and whether a speed comes late."""
    pairs = _pairs(dataset, simulator)
    findings, fits = _compared(pairs, simulator.control_step)
    if fits and 2 * len(fits) >= len(pairs):
        findings += _rate_findings(fits)
    late = [(pair, fit) for pair, fit in fits if fit.late]
    for pair, fit in late:
        what = f"it comes {fit.lag:.2g} ± {2.0 * fit.lag_error:.1g} s after the change of {pair.position}"
        remedy = "a filter or a driver delays it: log the raw speed, or leave its signal out of the spec"
        findings.append(Finding("warning", what, pair.speed, remedy))
    return findings, bool(late)


def _compared(pairs: list[_Pair], control_step: float) -> tuple[list[Finding], list[tuple[_Pair, "_Fit"]]]:
    """Findings of jumps and units, and fits of the pairs that have neither."""
    findings: list[Finding] = []
    fits: list[tuple[_Pair, _Fit]] = []
    for pair in pairs:
        turned = np.abs(np.abs(pair.change) - 2.0 * np.pi) < 0.1 * 2.0 * np.pi
        turned &= np.abs(pair.change - pair.expected) > np.pi
        if turned.any():
            what = f"it jumps by a whole turn in {int(turned.sum())} rows"
            findings.append(Finding("warning", what, pair.position, "unwrap the angle where it is logged"))
        slopes = _ratios(pair.change[~turned], pair.expected[~turned])
        if slopes is not None and not (slopes[0] < _NEAR[1] and slopes[1] > _NEAR[0]):
            ratio = slopes[0]
            mistake = unit_mistake(ratio)
            what = f"it changes {ratio:.3g} times as fast as {pair.speed} says" + (f": {mistake}?" if mistake else "")
            remedy = "look at units and signs in the spec and at control_step"
            findings.append(Finding("warning", what, pair.position, remedy, True))
        elif slopes is not None and not turned.any():
            fit = _fitted(pair, control_step)
            fits += [] if fit is None else [(pair, fit)]
    return findings, fits


def _pairs(dataset: Dataset, simulator: Simulator) -> list[_Pair]:
    """The joints whose position and speed are signals of their own; none of a model with ball or free joints."""
    task = simulator.task
    if task.state_from_observation is None:
        return []
    model = task.model
    if model.nq != model.nv:
        return []
    logged = dataset.transitions
    before, after = (
        np.asarray(task.state_from_observation(np.asarray(part, np.float64)))[:, : 2 * model.nv]
        for part in (logged.observation, logged.next_observation)
    )
    starts, lengths = dataset.episode_starts, dataset.episode_ends - dataset.episode_starts
    places = (np.arange(len(dataset)) - np.repeat(starts, lengths)) / np.repeat(np.maximum(lengths - 1, 1), lengths)
    names, pairs = _names_of_states(task, 2 * model.nv), []
    for dof in range(model.nv):
        position, speed = names[dof], names[model.nv + dof]
        if position is None or speed is None:
            continue
        change = after[:, dof] - before[:, dof]
        first, last = before[:, model.nv + dof], after[:, model.nv + dof]
        expected = 0.5 * (first + last) * simulator.control_step
        pairs.append(_Pair(position, speed, change, expected, places - 0.5, starts, impacts(last - first)))
    return pairs


def impacts(change: Float[np.ndarray, " rows"]) -> Bool[np.ndarray, " rows"]:
    """Rows whose change of speed is unlike that of their neighbours, whose median a smooth change follows.

    It is also larger than the usual change of the whole log, which in speeds of an encoder is one of its steps.
    """
    moving = np.abs(change[change != 0.0])
    if not len(moving):
        return np.zeros(len(change), bool)
    apart = change - median_filter(change, _NEIGHBOURS)
    usual = np.maximum(2.0 * median_filter(np.abs(change), _NEIGHBOURS), _STEPS * np.median(moving))
    return np.abs(apart) > np.maximum(JUMP * median_abs_deviation(apart, scale="normal"), usual)


def _ratios(change: Float[np.ndarray, " rows"], expected: Float[np.ndarray, " rows"]) -> tuple[float, float] | None:
    """The slope of the changes by the expected ones, and of the inverse regression; None where they hardly correlate.

    What speeds have that does not move the position, as noise or what shakes faster than the rows, makes the first too
    small and leaves the second.
    """
    power, together, changed = float(expected @ expected), float(change @ expected), float(change @ change)
    if power == 0.0 or changed == 0.0 or together**2 < _TRUSTED * power * changed:
        return None
    return together / power, changed / together


def unit_mistake(ratio: float) -> str:
    """The mistake of a unit or a sign that explains a ratio of two speeds, as a clause; empty for any other."""
    factors = ((each, text) for factor, text in _UNIT_ERRORS.items() for each in (factor, 1.0 / factor))
    return next((text for factor, text in factors if abs(ratio / factor - 1.0) < 0.1), "")


@dataclass(frozen=True)
class _Fit:
    """The change of a position by the speed, each number with its standard error.

    Over each stretch it is b e + s x e + τ e' + c e'' with the change e that the speed implies, the place x in the run,
    and the first and second differences of e from row to row: the ratio b, its drift s over a run, the lag τ of the
    speed, and c for the error of the trapezoidal rule. Noise of the speed makes b too small and the slope of the
    inverse regression too large.
    """

    ratio: float
    ratio_error: float
    inverse: float
    drift: float
    drift_error: float
    lag: float
    lag_error: float
    control_step: float

    @property
    def deviation(self) -> float:
        """How far the ratio is from 1: the nearest that noise of the speed allows, 0 where it allows 1 itself."""
        ends = self.ratio - 1.0, self.inverse - 1.0
        return min(ends, key=abs) if ends[0] * ends[1] > 0.0 else 0.0

    @property
    def late(self) -> bool:
        """Whether the speed certainly comes late."""
        return self.lag > max(LATE * self.control_step, CERTAIN * self.lag_error)


def _fitted(pair: _Pair, control_step: float) -> _Fit | None:
    """The regression of a position's change on its speed; None where it explains too little, or rests on too few.

    It rests on too few as well where the joint moves in a single part of the log: without that part, nothing is left.
    """
    stretches = _stretches(pair, max(2, round(STRETCH / control_step)))
    if len(stretches) < _FEWEST:
        return None
    products = np.stack([part.T @ part for part in np.array_split(stretches, _BLOCKS)])
    whole = products.sum(0)
    estimates = np.stack([whole, *(whole - products)])  # of the whole log, and without each of its parts
    inputs = len(whole) - 1
    rounding = np.finfo(float).eps * inputs * np.linalg.norm(whole[:-1, :-1], 2)
    if np.linalg.matrix_rank(estimates[:, :-1, :-1], tol=rounding, hermitian=True).min() < inputs:
        return None
    solutions = np.stack([np.linalg.solve(each[:-1, :-1], each[:-1, -1]) for each in estimates])
    if solutions[0] @ whole[:-1, -1] < _EXPLAINED * whole[-1, -1]:
        return None
    errors = np.sqrt((_BLOCKS - 1) * solutions[1:].var(0))
    (ratio, drift, lag, _), (ratio_error, drift_error, lag_error, _) = solutions[0].tolist(), errors.tolist()
    return _Fit(
        ratio=ratio,
        ratio_error=ratio_error,
        inverse=float(whole[-1, -1] / whole[0, -1]),
        drift=drift,
        drift_error=drift_error,
        lag=lag * control_step,
        lag_error=lag_error * control_step,
        control_step=control_step,
    )


def _rate_findings(fits: list[tuple[_Pair, _Fit]]) -> list[Finding]:
    """Findings on rows that are not a control step apart, on average or towards the end of a run.

    Time is the same for all joints, so that of the joint which shows the least of it counts.
    """
    findings = []
    pair, fit = min(fits, key=lambda each: abs(each[1].deviation))
    if abs(fit.deviation) > max(SAME_RATE, CERTAIN * fit.ratio_error) and _one_side([f.deviation for _, f in fits]):
        what = f"it changes {fit.ratio:.4g} ± {2.0 * fit.ratio_error:.1g} times as much as {pair.speed} says"
        apart = f"{abs(100 * fit.deviation):.2g} % {'farther apart' if fit.ratio > 1.0 else 'closer together'}"
        remedy = f"rows {apart} than control_step would explain it, or another unit: check clock, units and gears"
        findings.append(Finding("warning", what, pair.position, remedy))
    pair, fit = min(fits, key=lambda each: abs(each[1].drift))
    if abs(fit.drift) > max(SAME_RATE, CERTAIN * fit.drift_error) and _one_side([f.drift for _, f in fits]):
        begin, end = (fit.ratio + side * fit.drift / 2.0 for side in (-1.0, 1.0))
        what = f"it changes {begin:.3g} times as much as {pair.speed} says when a run begins, and {end:.3g} at its end"
        remedy = "the time between rows drifts, or a sensor's scale: check the recorder's clock"
        findings.append(Finding("warning", what, pair.position, remedy))
    return findings


def _one_side(values: list[float]) -> bool:
    return min(values) > 0.0 or max(values) < 0.0


def _stretches(pair: _Pair, rows: int) -> Float[np.ndarray, "stretches 5"]:
    """Sums over stretches of so many rows: e, x e, first and second difference of e, and the position's change."""
    found = []
    for start, end in zip(pair.starts, np.append(pair.starts, len(pair.change))[1:], strict=True):
        expected, count = pair.expected[start:end], (end - start - 2) // rows
        if count < 1:
            continue
        slope, bend = (expected[2:] - expected[:-2]) / 2.0, expected[2:] - 2.0 * expected[1:-1] + expected[:-2]
        inner = slice(1, 1 + count * rows)
        place, change = pair.places[start:end][inner], pair.change[start:end][inner]
        differences = (part[: count * rows] for part in (slope, bend))
        columns = (expected[inner], place * expected[inner], *differences, change)
        smooth = ~pair.hit[start:end][inner].reshape(count, rows).any(1)
        found.append(np.stack([column.reshape(count, rows).sum(1)[smooth] for column in columns], axis=-1))
    return np.concatenate(found) if found else np.zeros((0, 5))


def _names_of_states(task: Task, size: int) -> list[str | None]:
    """The signal from which each value of (qpos, qvel) is rebuilt; None where there is not exactly one."""
    assert task.state_from_observation is not None
    names, width = task.signal_names, task.observation_size
    base = np.asarray(task.state_from_observation(np.zeros((1, width))))[:, :size]
    moved = np.asarray(task.state_from_observation(np.eye(width)))[:, :size] - base
    sources = [np.flatnonzero(np.abs(moved[:, column]) > 1e-12) for column in range(size)]
    return [names[source[0]] if len(source) == 1 else None for source in sources]
