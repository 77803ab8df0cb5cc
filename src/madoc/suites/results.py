"""What the cells of a suite have found: one record a cell, and all of them as one table."""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from madoc.calibration.holdout import Verdict
from madoc.calibration.result import CalibrationResult, ParameterEstimate
from madoc.errors import MadocError, printable
from madoc.report.records import EvaluationRecord, read_object, read_record
from madoc.runs.files import read_json, replacing
from madoc.runs.machine import read_peak
from madoc.suites.cells import Cell
from madoc.suites.standing import Standing, asked

NOT_RUN = "not run"

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
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MadocError(f'--parquet needs pyarrow: pip install "madoc-calibration[logs]" ({error})') from error
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
