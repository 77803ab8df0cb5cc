"""What a suite has found, as one HTML page and as tables for other tools."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from madoc.errors import MadocError
from madoc.report.page import write_page
from madoc.report.words import TONES
from madoc.runs.files import write_json
from madoc.suites.cells import Cell
from madoc.suites.planning import Plan
from madoc.suites.results import NOT_RUN, Fleet, Result, fleets, ranges, results_of, rows, write_csv, write_parquet
from madoc.suites.standing import Standing, asked

LARGEST_PAGE = 2000
"""Largest number of single cells on the page; the tables have all."""
_TONES = {"finished": "good", "converged": "good", "diverged": "bad", "failed": "bad", "refused": "doubtful"}
"""Colour class of a cell without a verdict, by how it ended."""


@dataclass(frozen=True)
class Group:
    """Cells that ask for the same, and need cells that do, but for their seeds.

    Attributes:
        kind: `calibrate`, `learn` or `evaluate`.
        asks: What they and the cells that they need ask, by the keys of a suite file.
        seeds: Number of cells.
        words: Number of cells by verdict, or else by how they ended.
        error: Median, lowest and highest error in % of the ranges, where the truth is known.
        score: The same of the score on the hold-out.
        normalized: The same of normalized returns.
        seconds: Median seconds.
    """

    kind: str
    asks: str
    seeds: int
    words: Mapping[str, int]
    error: tuple[float, float, float] | None
    score: tuple[float, float, float] | None
    normalized: tuple[float, float, float] | None
    seconds: float | None


def write_report(
    plan: Plan, standing: Standing, suite: Path, *, command: str, parquet: bool = False
) -> dict[str, Path]:
    """Leave `SUITE.html` and `SUITE.csv` in the folder of a suite, and `SUITE-fleet.json` where it has several robots.

    With `parquet`, leave `SUITE.parquet` too. The command is what runs the cells that were not run. Returns the files
    by what they are.

    Raises:
        MadocError: The suite was never begun, a result is damaged, or a file cannot be written.
    """
    if not suite.is_dir():
        raise MadocError(f"there is nothing to report in {suite}; run the suite first: {command}")
    results = results_of(standing, suite)
    table = list(rows(results))
    files = {"page": suite / f"{plan.name}.html", "table": suite / f"{plan.name}.csv"}
    write_csv(files["table"], table)
    if parquet:
        files["parquet"] = suite / f"{plan.name}.parquet"
        write_parquet(files["parquet"], table)
    found = fleets(results)
    if found:
        files["fleet"] = suite / f"{plan.name}-fleet.json"
        write_json(files["fleet"], [fleet.to_json() for fleet in found])
    write_page(files["page"], "suite.html", _context(plan, standing, results, found, command))
    return files


def groups(results: Sequence[Result]) -> list[Group]:
    """The cells that ask for the same but for their seeds, each group as a row."""
    cells = {result.cell.name: result.cell for result in results}
    alike = defaultdict[tuple[str, str], list[Result]](list)
    for result in results:
        if result.cell.kind == "record" or result.cell.robot:
            continue
        alike[result.cell.kind, _asks(result.cell, cells, short=False)].append(result)
    return [_group(kind, _asks(members[0].cell, cells), members) for (kind, _), members in alike.items()]


def _group(kind: str, asks: str, members: Sequence[Result]) -> Group:
    calibrations = [result.calibration for result in members if result.calibration is not None]
    evaluations = [result.evaluation for result in members if result.evaluation is not None]
    costs = [calibration.seconds for calibration in calibrations]
    costs += [float(result.learnt["seconds"]) for result in members if "seconds" in result.learnt]
    return Group(
        kind,
        asks,
        len(members),
        Counter(_word(result) for result in members),
        _middle([result.error["mean_percent_of_range"] for result in members if result.error]),
        _middle([calibration.holdout.score for calibration in calibrations if calibration.holdout is not None]),
        _middle([row["normalized"] for told in evaluations for row in told.policies.values()]),
        median(costs) if costs else None,
    )


def _asks(cell: Cell, cells: Mapping[str, Cell], *, short: bool = True) -> str:
    """What the cells that a cell needs ask, and then the cell itself, in words, all but for their seeds."""
    told_before = ("needs", "robot", "data") if cell.needs else ()
    values = {key: value for key, value in asked(cell).items() if key not in ("seed", *told_before)}
    own = " ".join(f"{key}={_short(value) if short else value}" for key, value in values.items())
    needed = _asks(cells[cell.needs], cells, short=short) if cell.needs else ""
    return "; ".join(text for text in (needed, own) if text)


def _short(value: object) -> str:
    """A value in words; of an absolute path its last two parts."""
    if isinstance(value, list):
        return ",".join(_short(part) for part in value)
    return "/".join(Path(value).parts[-2:]) if isinstance(value, str) and value.startswith("/") else str(value)


def _middle(values: Sequence[float]) -> tuple[float, float, float] | None:
    """Median, lowest and highest."""
    return (median(values), min(values), max(values)) if values else None


def _word(result: Result) -> str:
    """The verdict of a cell, or else how it ended."""
    return result.verdict.word if result.verdict is not None else result.status


def _tone(word: str) -> str:
    return TONES.get(word) or _TONES.get(word, "neutral")


def _context(
    plan: Plan, standing: Standing, results: Sequence[Result], found: Sequence[Fleet], command: str
) -> dict[str, object]:
    """What the template shows."""
    single = [result for result in results if result.cell.kind != "record"]
    cells = {result.cell.name: result.cell for result in results}
    return {
        "title": plan.name,
        "file": plan.file.name,
        "counts": dict(standing.counts),
        "cells": len(results),
        "groups": groups(results),
        "fleets": [_drawn(fleet) for fleet in found],
        "results": [_line(result, cells) for result in single[:LARGEST_PAGE]],
        "omitted": max(0, len(single) - LARGEST_PAGE),
        "reasons": Counter(
            f"{result.status}: {result.sentence}" for result in results if result.status in ("refused", "failed")
        ),
        "not_run": sum(result.status == NOT_RUN for result in results),
        "command": command,
        "tone": _tone,
    }


def _line(result: Result, cells: Mapping[str, Cell]) -> dict[str, object]:
    """A single cell on the page."""
    reason = str(result.verdict.sentence) if result.verdict is not None else result.sentence
    return {
        "cell": result.cell.name,
        "asks": _asks(result.cell, cells),
        "seed": asked(result.cell).get("seed", 0),
        "word": _word(result),
        "reason": reason,
        "estimates": result.parameters,
    }


def _drawn(fleet: Fleet) -> dict[str, object]:
    """A fleet on the page: what is shared, and a lane for each robot and parameter."""
    told = ranges(fleet)
    return {
        "title": fleet.title,
        "robots": len(fleet.results),
        "left_out": fleet.left_out,
        "parameters": [_lanes(fleet, index, told) for index in range(len(fleet.parameters))],
    }


def _lanes(fleet: Fleet, index: int, told: Mapping[str, tuple[float, float]]) -> dict[str, object]:
    """One parameter of a fleet: its axis, its numbers, and an estimate for each robot."""
    shared = fleet.parameters[index]
    names = sorted([*shared.robots, *shared.outliers])
    lanes = {name: fleet.results[name].parameters[shared.name] for name in names}
    return {
        "shared": shared,
        "range": told.get(shared.name),
        "low": min(row.low for row in lanes.values()),
        "high": max(row.high for row in lanes.values()),
        "lanes": lanes,
    }
