"""Several robots of one kind: their estimates side by side, what they share, and which do not belong."""

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass

import numpy as np

from madoc.calibration.result import ParameterEstimate
from madoc.identification.information import NORMAL_95
from madoc.identification.random_effects import Common, common, outliers
from madoc.suites.results import Result

_FEWEST = 2
"""Fewest robots that share anything."""


@dataclass(frozen=True)
class SharedParameter:
    """One parameter over the robots of a fleet.

    Attributes:
        name: Of the parameter.
        unit: Its unit.
        robots: Names of the robots that count.
        common: What these share; None of fewer than two.
        outliers: Robots that do not belong to the others, and the probability of one so far off by chance.
    """

    name: str
    unit: str
    robots: tuple[str, ...]
    common: Common | None
    outliers: Mapping[str, float]


@dataclass(frozen=True)
class Fleet:
    """The robots of one entry of a suite file, calibrated alike.

    Attributes:
        title: What was asked of all of them.
        results: The calibration of each robot, by its name.
        left_out: Robots that do not count, and why.
        parameters: What the others share.
    """

    title: str
    results: Mapping[str, Result]
    left_out: Mapping[str, str]
    parameters: tuple[SharedParameter, ...]

    def to_json(self) -> dict[str, object]:
        """What robots share, and who does not, without the single results."""
        return {
            "title": self.title,
            "robots": list(self.results),
            "left_out": dict(self.left_out),
            "parameters": [asdict(row) for row in self.parameters],
            "ranges": ranges(self),
        }


def fleets(results: Iterable[Result]) -> list[Fleet]:
    """The fleets among the results of a suite: calibrations of several robots that differ in the log alone."""
    groups = defaultdict[str, dict[str, Result]](dict)
    for result in results:
        if result.cell.robot and result.cell.kind == "calibrate":
            asked = result.cell.asks
            asked.pop("data", None)
            groups[json.dumps([result.cell.entry, asked])][result.cell.robot] = result
    return [_fleet(title, robots) for title, robots in groups.items()]


def _fleet(key: str, robots: Mapping[str, Result]) -> Fleet:
    """A fleet, with what its robots share."""
    left_out = {name: reason for name, result in robots.items() if (reason := _left_out(result))}
    counting = {name: result for name, result in robots.items() if name not in left_out}
    names = dict.fromkeys(parameter for result in counting.values() for parameter in result.parameters)
    shared = tuple(_shared(parameter, counting) for parameter in names)
    asked = json.loads(key)[1]
    title = " ".join(f"{key}={value}" for key, value in asked.items() if key in ("method", "seed", "budget"))
    return Fleet(title, robots, left_out, shared)


def _left_out(result: Result) -> str:
    """Why a robot does not count; empty if it does."""
    if not result.parameters:
        return result.status if result.status == "not run" else f"{result.status}: {result.sentence}"
    if result.verdict is not None and result.verdict.word != "CALIBRATED":
        return str(result.verdict)
    if any(row.interval is None for row in result.parameters.values()):
        return f"{result.method} gives no intervals"
    return ""


def _shared(name: str, robots: Mapping[str, Result]) -> SharedParameter:
    """One parameter: outliers first, and what the others share."""
    having = [robot for robot, result in robots.items() if name in result.parameters]
    rows = [robots[robot].parameters[name] for robot in having]
    estimates = np.array([row.estimate for row in rows], dtype=np.float64)
    errors = np.array([_standard_error(row) for row in rows])
    found = outliers(estimates, errors)
    kept = [index for index in range(len(having)) if index not in found]
    told = common(estimates[kept], errors[kept]) if len(kept) >= _FEWEST else None
    counting = tuple(having[index] for index in kept)
    odd = {having[index]: chance for index, chance in found.items()}
    return SharedParameter(name, rows[0].unit, counting, told, odd)


def _standard_error(row: ParameterEstimate) -> float:
    """The standard error that a 95 % interval stands for; an interval of no width counts as one of rounding's."""
    smallest = np.finfo(np.float64).eps * max(abs(row.estimate), 1e-12)
    return float(max(row.half_width, smallest) / NORMAL_95)


def ranges(fleet: Fleet) -> dict[str, tuple[float, float]]:
    """Ranges to randomize in, for a robot of the kind that is not in the fleet, by parameter.

    They are within the range that was searched.
    """
    told: dict[str, tuple[float, float]] = {}
    for row in fleet.parameters:
        if row.common is None or row.common.range is None:
            continue
        searched = [fleet.results[robot].parameters[row.name] for robot in row.robots]
        low, high = min(part.low for part in searched), max(part.high for part in searched)
        told[row.name] = (max(row.common.range[0], low), min(row.common.range[1], high))
    return told
