"""Readings of an inertial measurement unit against each other: quaternions, rates of turn, accelerations."""

from collections import Counter

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from madoc.data import Dataset
from madoc.data.findings import Finding
from madoc.diagnosis.speeds import STRETCH, unit_mistake
from madoc.robots import Robot
from madoc.robots.expressions import parse
from madoc.robots.signals import frame_of, frame_of_attitude, is_accelerometer, is_gyroscope

LENGTH = 0.05
"""Median difference from 1 of the length of a logged quaternion; beyond it, it is no attitude."""
AGREES = 0.5
"""Squared correlation in [0, 1] of turns by the attitude and by a gyroscope; from it on they are of one motion."""
BETTER = 0.8
"""The same from which another order or direction of the quaternion is told, where the one given does not agree."""
WEIGHTLESS = 0.3
"""Median length of an accelerometer's reading over gravity, below which gravity seems to have been taken away."""
_MISTAKES = {1.0: "in g", 1e3: "in thousandths of g"}
"""Units of accelerations by the readings of a sensor at rest."""
_ORDERS = {"w, x, y, z": [0, 1, 2, 3], "x, y, z, w": [3, 0, 1, 2]}
"""Where w, x, y and z are among four columns, by their order; the first is the one that a spec gives."""


def inertial_findings(dataset: Dataset, robot: Robot, control_step: float) -> list[Finding]:
    """Findings on attitudes that are none, or have another order or direction, and on units of rates and accelerations.

    Readings are compared with each other alone; the model is not simulated.
    """
    model = robot.task.model
    readings = _readings(dataset, robot)
    rates = {name: read for name, read in readings.items() if is_gyroscope(model, name)}
    findings = _incomplete(robot)
    for places in robot.task.attitudes:
        where = ", ".join(robot.signals[place].name for place in places)
        quaternion = np.asarray(dataset.transitions.observation, np.float64)[:, places]
        lengths = np.linalg.norm(quaternion, axis=-1)
        length = float(np.median(lengths))
        if abs(length - 1.0) > LENGTH:
            what = f"their length is {length:.3g}, and that of a quaternion is 1"
            findings.append(
                Finding("fatal", what, where, "divide counts by their scale, or leave them out of the spec")
            )
            continue
        attitude = frame_of_attitude(model, robot.signals[places[0]].quaternion)
        for name, rate in rates.items():
            gyroscope = frame_of(model, name)
            if attitude is not None and gyroscope is not None and attitude.body == gyroscope.body:
                to_gyroscope = gyroscope.axes.inv() * attitude.axes
                whole = np.where(lengths[:, None] > 0.5, quaternion, np.nan)  # a reading of zeros is a gap
                findings += _turning(dataset, whole, rate, to_gyroscope, where, name, control_step)
    gravity = float(np.linalg.norm(model.opt.gravity))
    for name, read in readings.items():
        if is_accelerometer(model, name) and gravity:
            findings += _acceleration(name, float(np.median(np.linalg.norm(read, axis=-1))), gravity)
    return findings


def _readings(dataset: Dataset, robot: Robot) -> dict[str, Float[np.ndarray, "rows 3"]]:
    """What sensors of three values read, by name: those of which every value is a signal by itself, scaled or not."""
    observation = np.asarray(dataset.transitions.observation, np.float64)
    found: dict[str, dict[int, Float[np.ndarray, " rows"]]] = {}
    for place, signal in enumerate(robot.signals):
        affine = parse(signal.reads).affine()
        if affine is None or len(affine[0]) != 1:
            continue
        ((read, gain),) = affine[0].items()
        if read.kind == "sensor":
            found.setdefault(read.name, {}).setdefault(read.index or 0, (observation[:, place] - affine[1]) / gain)
    whole = {name: values for name, values in found.items() if set(values) == {0, 1, 2}}
    return {name: np.stack([values[axis] for axis in range(3)], axis=-1) for name, values in whole.items()}


def _turning(
    dataset: Dataset,
    quaternion: Float[np.ndarray, "rows 4"],
    rate: Float[np.ndarray, "rows 3"],
    to_gyroscope: Rotation,
    where: str,
    gyroscope: str,
    control_step: float,
) -> list[Finding]:
    """Findings on the turn of an attitude over stretches of a run, compared with the gyroscope's over the same.

    Stretches that begin or end at a row whose quaternion is NaN are left out.
    """
    rows = max(1, round(STRETCH / control_step))
    first = _stretches(dataset, rows)
    first = first[np.isfinite(quaternion[first] + quaternion[first + rows]).all(-1)]
    summed = np.cumsum(np.concatenate([np.zeros((1, 3)), rate]), axis=0)
    ends = 0.5 * (rate[first] + rate[first + rows])
    measured = control_step * (summed[first + rows] - summed[first + 1] + ends)
    if not len(first) or not measured.any():
        return []
    found: dict[tuple[str, bool], tuple[float, float]] = {}
    for order, columns in _ORDERS.items():
        last_w = [*columns[1:], columns[0]]
        before, after = (Rotation.from_quat(quaternion[part][:, last_w]) for part in (first, first + rows))
        for inverse in (False, True):
            turned = before * after.inv() if inverse else before.inv() * after
            found[order, inverse] = _compared(measured, to_gyroscope.apply(turned.as_rotvec()))
    given = next(iter(_ORDERS)), False
    explained, ratio = found[given]
    if explained >= AGREES:
        mistake = unit_mistake(ratio)
        what = f"it turns {abs(ratio):.3g} times as fast as the attitude of {where}: {mistake}?"
        remedy = "look at units and signs in the spec"
        return [Finding("warning", what, f"sensor({gyroscope})", remedy, True)] if mistake else []
    order, inverse = max(found, key=lambda each: found[each][0])
    if found[order, inverse][0] < BETTER:
        return []
    what = f"their changes agree with sensor({gyroscope}) as {order}" + (", with x, y and z negated" if inverse else "")
    remedy = "MuJoCo's order is w, x, y, z, and its quaternion turns the body's axes into the world's: map them so"
    return [Finding("warning", what, where, remedy, True)]


def _stretches(dataset: Dataset, rows: int) -> Int[np.ndarray, " stretches"]:
    """First rows of stretches of so many rows that follow each other within an episode."""
    bounds = zip(dataset.episode_starts, dataset.episode_ends, strict=True)
    return np.concatenate([np.arange(start, end - rows, rows) for start, end in bounds])


def _compared(measured: Float[np.ndarray, "n 3"], turn: Float[np.ndarray, "n 3"]) -> tuple[float, float]:
    """The squared correlation about 0 of both, and the slope of the measured by the other."""
    power, together = float((turn**2).sum()), float((measured * turn).sum())
    return (together**2 / (power * float((measured**2).sum())), together / power) if power else (0.0, 0.0)


def _acceleration(sensor: str, length: float, gravity: float) -> list[Finding]:
    """Findings on the median length of an accelerometer's reading: at rest it is gravity."""
    where = f"sensor({sensor})"
    mistake = next((text for factor, text in _MISTAKES.items() if abs(length / factor - 1.0) < 0.1), None)
    if mistake and abs(length / gravity - 1.0) > 0.1:
        what = f"its reading is {length:.3g} long in the median, where gravity is {gravity:.3g} m/s²: {mistake}?"
        return [Finding("warning", what, where, "look at its unit in the spec", True)]
    if length < WEIGHTLESS * gravity:
        what = f"its reading is {length:.3g} m/s² long in the median, and at rest it would be {gravity:.3g}"
        return [Finding("warning", what, where, "was gravity taken away? MuJoCo's accelerometer shows it: log it raw")]
    return []


def _incomplete(robot: Robot) -> list[Finding]:
    """Findings on sensors of whose quaternion a spec shows some values."""
    reads = {read for row in robot.signals for read in parse(row.reads).reads}
    seen = Counter(f"{read.kind}({read.name})" for read in reads)
    shown = Counter(row.quaternion for row in robot.signals if row.quaternion.startswith("sensor("))
    return [
        Finding(
            "warning",
            f"signals show {count} of its 4 values, which tell no attitude",
            source,
            "add the others, [0] to [3] are w, x, y and z",
        )
        for source, count in shown.items()
        if count < 4 and seen[source] < 4
    ]
