"""Cells of the paper's suites: what they ask, what was kept of them, and what the paper prints beside them."""

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from kept import CALIBRATIONS, RESULTS, Study, commits, is_time
from pooling import OUR_LOGS, Rows, by_log, label, logs, order, ratio

from madoc import tasks
from madoc.suites.cells import Cell, Kind
from madoc.suites.planning import Plan, plan_of

SUITES = Path(__file__).parent / "suites"
OUT = "runs/paper"
STUDIES = {name: Study(RESULTS / f"{name}.jsonl", ("cell",)) for name in ("returns", "table-3", "figure-2")}
"""What was collected of suites, by cell: returns of policies, which tables share, and what is no score. Calibrations
are rows of `kept.CALIBRATIONS`, beside those that were run without a suite."""


@cache
def planned(name: str) -> Plan:
    """The plan of a suite."""
    return plan_of(SUITES / f"{name}.yaml")


def wanted(plan: Plan) -> list[Cell]:
    """The cells that a suite asks for itself."""
    return [cell for cell in plan.cells if cell.wanted]


def chain_of(cell: Cell, plan: Plan) -> dict[Kind, Cell]:
    """A cell and those that it needs, by their kinds."""
    by_name = {each.name: each for each in plan.cells}
    chain = {cell.kind: cell}
    while cell.needs:
        cell = by_name[cell.needs]
        chain[cell.kind] = cell
    return chain


def kept(name: str) -> dict[str, dict[str, Any]]:
    """What was collected for a table whose cells have a study of their own, by cell."""
    return {row["cell"]: row for row in STUDIES.get(name, STUDIES["returns"]).rows()}


def command(name: str) -> str:
    """How the cells of a suite are run."""
    return f"`madoc suite benchmarks/suites/{name}.yaml --out {OUT}`"


def how_far(name: str, cells: Sequence[Cell]) -> str:
    """How many of a suite's cells are not run, the command that runs them, and at which commits they were collected."""
    found = kept(name)
    commits = Counter(found[cell.name]["commit"] for cell in cells if cell.name in found)
    missing = len(cells) - commits.total()
    told = f"{missing} of {len(cells)} cells are not run: {command(name)}" if missing else f"All run by {command(name)}"
    collected = ", ".join(f"{count} at {each}" for each, count in commits.most_common())
    return f"{told}; collected {collected}" if collected else told


def printed(name: str, row: str, column: str) -> tuple[float, float] | None:
    """Mean and 95 % interval that the paper prints in a cell of a table; None where it prints none."""
    cell = _printed().get(name, {}).get(row, {}).get(column)
    return None if cell is None else (cell[0], cell[1])


def printed_number(name: str, row: str, column: str) -> float | None:
    """The number that the paper prints without an interval in a cell of a table; None where it prints none."""
    cell = _printed().get(name, {}).get(row, {}).get(column)
    return None if cell is None else cell[0]


@cache
def _printed() -> dict[str, dict[str, dict[str, list[float]]]]:
    return json.loads((SUITES / "printed.json").read_text())


ERRORS = {
    "table-10": "Table 10: mean absolute calibration error, D4RL's qualities",
    "table-11": "Table 11: mean absolute calibration error, NeoRL's qualities",
    "table-12": "Table 12: mean absolute calibration error by the kind of credit",
    "figure-3b-errors": "Figure 3b: mean calibration error by the number of parameters, in % of their ranges",
    "figure-7": "Figure 7: mean absolute calibration error by the number of groups and α",
}
"""What is a table of calibration errors; the paper's table 12 and figure 7 are of returns, which tell less of them."""
MEASURES = {"figure-3b-errors": "mean_percent_of_range"}
"""What is shown of an error, where that is not `mean_absolute`: a mean over other parameters has other units."""
PRINTED = {"table-10", "table-11"}
"""Tables of errors for which the paper prints figures; they show every method that was run on their tasks as it is."""
Place = tuple[str, str]
"""Row and column of a table."""
ROWS = 200_000
"""Of a log of the tables."""


def table_of_errors(name: str) -> str:
    """Errors by task and method beside the printed ones, with the commits of each row, and means over tasks."""
    grid, found = places(name), calibrations(name)
    rows = list(dict.fromkeys(row for row, _ in grid))
    columns = list(dict.fromkeys(column for _, column in grid))
    if name in PRINTED:
        others = {place[1] for place, kept in found.items() if place[0] in rows and not kept[0].get("set")}
        columns = sorted({*columns, *others}, key=order)
    missing = len({*grid} - found.keys())
    those = f"{missing} of {len(grid)} cells are not run" if missing else f"All {len(grid)} cells are run"
    told = f"{those}: `python benchmarks/calibration.py`, or {command(name)}."
    if missing == len(grid) and name not in PRINTED:
        return f"{told}\n"
    lines = [
        f"{told} {OUR_LOGS}\n" if name in PRINTED else f"{told}\n",
        f"| task | {' | '.join(columns)} | commits |",
        "|---" * (2 + len(columns)) + "|",
    ]
    for row in rows:
        of_row = [found.get((row, column), []) for column in columns]
        theirs = [printed(name, row, column) for column in columns]
        cells = [error_cell(*pair, MEASURES.get(name, "mean_absolute")) for pair in zip(of_row, theirs, strict=True)]
        lines.append(f"| {row} | {' | '.join(cells)} | {commits(chain.from_iterable(of_row))} |")
    if name in PRINTED:
        over = [_over_tasks([found.get((row, column), []) for row in rows]) for column in columns]
        lines.append(f"| mean over the tasks run | {' | '.join(over)} | |")
    by_column = [[each for row in rows for each in found.get((row, column), [])] for column in columns]
    ratios = [_ratio(of_column, by_column[0]) for of_column in by_column[1:]]
    if any(ratios):
        lines.append(f"| error over that of {columns[0]} (95 % over logs) | | {' | '.join(ratios)} | |")
    return "\n".join(lines) + "\n"


def calibrations(name: str) -> dict[Place, list[Mapping]]:
    """The calibrations to clean logs that a table of errors may show, by their place: those of the budget run last."""
    cells = defaultdict[Place, list[Mapping]](list)
    for row in CALIBRATIONS.rows():
        usual = row["data"] == "clean" and row["transitions"] == ROWS and "level" not in row
        if usual and not is_time(row["budget"]) and ("calibrated" not in row or name in MEASURES):
            cells[place_of(name, row)].append(row)
    return {place: [row for row in rows if row["budget"] == rows[-1]["budget"]] for place, rows in cells.items()}


def places(name: str) -> list[Place]:
    """The places that a suite asks for, each once."""
    plan = planned(name)
    return list(dict.fromkeys(place_of(name, as_asked(chain_of(cell, plan))) for cell in wanted(plan)))


def place_of(name: str, row: Mapping) -> Place:
    """Where a calibration stands in a table of errors."""
    task = f"{row['robot']}-{row['quality']}"
    if name in MEASURES:
        task += f", {in_words(len(row.get('calibrated') or tasks.make(row['robot']).parameters))}"
    return task, label(row)


def as_asked(cells: Mapping[Kind, Cell]) -> dict:
    """What a suite asks of a calibration, in the words of `calibration.py`; its logs are of the paper's truth."""
    told, recording = cells["calibrate"].asks, cells["record"].asks
    robot, _, quality = str(recording["name"]).partition("-")
    row = {"robot": robot, "quality": quality, "data": "clean", "transitions": recording.get("transitions", ROWS)}
    row |= {"method": told["method"], "log": f"suite {recording.get('seed', 0)}", "seed": told.get("seed", 0)}
    row |= {"budget": told["budget"], "cell": cells["calibrate"].name}
    row |= {"level": told["level"]} if "level" in told else {}
    row |= {"set": [text for group in told["set"] for text in group]} if told.get("set") else {}
    return row | ({"calibrated": list(told["parameters"])} if told.get("parameters") else {})


def error_cell(rows: Rows, paper: tuple[float, float] | None, measure: str = "mean_absolute") -> str:
    """A cell of a table of errors: the mean over logs, how many, and in brackets what is printed."""
    beside = f" [{paper[0]:g} ± {paper[1]:g}]" if paper else ""
    errors = by_log(rows, measure)
    if not errors:
        return ("refuses" if rows else "not run") + beside
    budget = rows[0]["budget"]
    steps = f", {budget:,} steps" if budget != 300_000 and rows[0]["control_steps"] else ""
    return f"{np.mean(list(errors.values())):.2g} ({logs(len(errors))}{steps}){beside}"


def _over_tasks(cells: Sequence[Rows]) -> str:
    """The mean of one method over the tasks on which it was run, if all are of one commit and budget."""
    run = [list(by_log(rows).values()) for rows in cells if by_log(rows)]
    told = f"{np.mean([np.mean(errors) for errors in run]):.2g} ({len(run)} tasks)" if run else ""
    return told and (_mixed(chain.from_iterable(cells)) or told)


def _ratio(ours: Rows, theirs: Rows) -> str:
    """The ratio of the errors of two methods on the logs that both have, if all are of one commit and budget."""
    told = ratio(*(by_log(rows, "mean_percent_of_range") for rows in (ours, theirs)))
    return told and (_mixed([*ours, *theirs]) or told)


def _mixed(rows: Iterable[Mapping]) -> str:
    """Why rows are not put together, or nothing."""
    listed = list(rows)
    if commits(listed).startswith("mixed"):
        return "several commits"
    return "several budgets" if len({row["budget"] for row in listed}) > 1 else ""


def in_words(count: int) -> str:
    """A number of parameters."""
    return f"{count} parameter{'s' * (count > 1)}"
