"""Cells of the paper's suites: what they ask, what was kept of them, and what the paper prints beside them."""

import json
from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from kept import RESULTS, Study

from madoc.suites.cells import KINDS, Cell, Kind
from madoc.suites.options import flat
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


def asked(cell: Cell) -> dict:
    """What a cell asks, by the keys of a suite file."""
    return flat(KINDS[cell.kind], cell.order)


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
