"""What the cells of a suite have found: one record a cell, all of them as one table, and fleets.

A fleet is several robots of one kind: their estimates side by side, what they share, and which do not belong.
"""

import csv
import io
import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from madoc.calibration.holdout import Verdict
from madoc.calibration.result import CalibrationResult, ParameterEstimate
from madoc.errors import needing, printable
from madoc.identification.information import NORMAL_95
from madoc.identification.random_effects import Common, common, outliers
from madoc.report.records import EvaluationRecord, read_object, read_record
from madoc.runs.files import read_json, replacing
from madoc.runs.machine import read_peak
from madoc.suites.cells import Cell
from madoc.suites.standing import Standing, asked

NOT_RUN = "not run"

_FEWEST = 2
"""Fewest robots that share anything."""

COLUMNS: dict[str, type] = {
    **{"cell": str, "kind": str, "robot": str, "task": str, "data": str, "method": str, "at": str, "seed": int},
    **{"budget": str, "settings": str, "other": str, "needs": str, "status": str, "sentence": str, "verdict": str},
    **{"verdict_sentence": str, "holdout_score": float, "holdout_low": float, "holdout_high": float},
    **{"control_steps": int, "seconds": float, "peak_memory": int, "error_mean_absolute": float},
    **{"error_percent_of_range": float},
    **{"parameter": str, "unit": str, "estimate": float, "interval_low": float, "interval_high": float, "std": float},
    **{"low": float, "high": float, "error": float, "policy": str, "where": str, "return": float, "return_std": float},
    **{"normalized": float, "episodes": int},
}
"""Columns of the table and the types of their values; a calibration has a row a parameter, an evaluation one for each
policy and place: `target` where its parameters are known, and `estimate`."""


@dataclass(frozen=True)
class Result:
    """What a cell has found; empty where it has not ended or was refused.

    Attributes:
        cell: The cell.
        status: How it ended, or `not run`.
        sentence: The status in words.
        method: Of a calibration or policy: the one that was kept, where several were tried.
        calibration: Of a calibration that has ended: its estimate, verdict and error.
        evaluation: Of an evaluation that has ended: the returns of its policy.
        learnt: Of a policy that has ended: the content of its `result.json`.
        peak_memory: The most resident memory that its process held, bytes; None where it is not known.
    """

    cell: Cell
    status: str
    sentence: str = ""
    method: str = ""
    calibration: CalibrationResult | None = None
    evaluation: EvaluationRecord | None = None
    learnt: Mapping[str, Any] = field(default_factory=dict)
    peak_memory: int | None = None

    @property
    def parameters(self) -> dict[str, ParameterEstimate]:
        """Estimates by name; empty where there are none."""
        return {} if self.calibration is None else self.calibration.parameters

    @property
    def verdict(self) -> Verdict | None:
        """The verdict on a calibration; None where nothing was held out."""
        return None if self.calibration is None else self.calibration.verdict

    @property
    def error(self) -> Mapping[str, Any]:
        """Errors of a calibration; empty where the truth is not known."""
        return (self.calibration.error or {}) if self.calibration is not None else {}


def results_of(standing: Standing, suite: Path) -> list[Result]:
    """The result of every cell, in the order of the suite."""
    return [_result(cell, standing, suite) for cell in standing.cells.values()]


def rows(results: Sequence[Result]) -> Iterator[dict[str, Any]]:
    """The results as rows of `COLUMNS`; a value that is not known is missing."""
    for result in results:
        whole = _row(result)
        for name, row in result.parameters.items():
            low, high = row.interval or (None, None)
            of_row = {"unit": row.unit, "estimate": row.estimate, "std": row.std, "low": row.low, "high": row.high}
            off = result.error.get("per_parameter", {}).get(name)
            yield whole | of_row | {"parameter": name, "interval_low": low, "interval_high": high, "error": off}
        if result.evaluation is not None:
            places = {"target": result.evaluation.policies, "estimate": result.evaluation.at_estimate}
            for where, policies in places.items():
                for name, returns in policies.items():
                    known = {key: returns[key] for key in ("return", "return_std", "normalized")}
                    yield whole | known | {"policy": name, "where": where, "episodes": result.evaluation.episodes}
        elif not result.parameters:
            yield whole


def write_csv(file: Path, table: Sequence[dict[str, Any]]) -> None:
    """Leave the table as CSV, whole or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(COLUMNS), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(row.get(name)) for name in COLUMNS} for row in table)
    with replacing(file) as stream:
        stream.write(text.getvalue().encode())


def _cell(value: object) -> object:
    """A value as a cell; text that a spreadsheet would take for a formula begins with an apostrophe."""
    if not isinstance(value, str):
        return value
    return f"'{printable(value)}" if value.startswith(("=", "+", "-", "@", "\t", "\r")) else printable(value)


def write_parquet(file: Path, table: Sequence[dict[str, Any]]) -> None:
    """Leave the table as Parquet, whole or not at all.

    Raises:
        MadocError: pyarrow is not installed.
    """
    with needing("--parquet needs pyarrow:", "madoc-calibration[logs]"):
        import pyarrow
        import pyarrow.parquet
    types = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64()}
    schema = pyarrow.schema([(name, types[kind]) for name, kind in COLUMNS.items()])
    columns = [{name: row.get(name) for name in COLUMNS} for row in table]
    with replacing(file) as stream:
        pyarrow.parquet.write_table(pyarrow.Table.from_pylist(columns, schema=schema), stream)


def _result(cell: Cell, standing: Standing, suite: Path) -> Result:
    """The result of one cell."""
    method = str(asked(cell).get("method", ""))
    if cell.name not in standing.ended:
        return Result(cell, NOT_RUN, method=method)
    outcome, folder = standing.ended[cell.name][1], cell.folder(suite)
    result = Result(cell, outcome.status, outcome.sentence, method, peak_memory=read_peak(folder))
    if not outcome.usable:
        return result
    match cell.kind:
        case "calibrate":
            calibration = CalibrationResult.from_json(read_json(folder / "result.json"))
            return replace(result, calibration=calibration, method=calibration.method)
        case "learn":
            return replace(result, learnt=read_object(folder / "result.json"))
        case "evaluate":
            return replace(result, evaluation=read_record(EvaluationRecord, folder / "evaluation.json"))
    return result


def _row(result: Result) -> dict[str, Any]:
    """What all rows of a result have in common."""
    values: dict[str, Any] = asked(result.cell)
    own = ("robot", "task", "method", "at", "seed", "needs")
    rest = {key: value for key, value in values.items() if key not in (*own, "data", "budget", "set")}
    held = None if result.calibration is None else result.calibration.holdout
    cost = result.learnt if result.calibration is None else vars(result.calibration)
    row = {key: values[key] for key in own if key in values} | {
        "cell": result.cell.name,
        "kind": result.cell.kind,
        "method": result.method or None,
        "data": " ".join(values.get("data", [])) or None,
        "seed": values.get("seed", 0),
        "budget": str(values["budget"]) if "budget" in values else None,
        "settings": " ".join(text for group in values.get("set", []) for text in group) or None,
        "other": " ".join(f"{key}={value}" for key, value in rest.items()) or None,
        "status": result.status,
        "sentence": result.sentence or None,
        "control_steps": cost.get("control_steps"),
        "seconds": cost.get("seconds"),
        "peak_memory": result.peak_memory,
        "error_mean_absolute": result.error.get("mean_absolute"),
        "error_percent_of_range": result.error.get("mean_percent_of_range"),
    }
    if result.verdict is not None:
        row |= {"verdict": result.verdict.word, "verdict_sentence": result.verdict.sentence}
    if held is not None:
        low, high = held.score_interval
        row |= {"holdout_score": held.score, "holdout_low": low, "holdout_high": high}
    return row


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
