"""The paper's tables and figures: what was found, beside what the paper prints.

    python benchmarks/calibration.py --tasks ... --methods ...         # any cell of the tables of errors
    madoc suite benchmarks/suites/table-10.yaml --out runs/paper       # or as a suite, which may be stopped at any time
    python benchmarks/paper.py --collect runs/paper                    # keeps what has ended of all suites there
    python benchmarks/paper.py                                         # prints the tables, and writes results/paper.md

Tables of errors show every calibration that was kept, wherever it was run. Suites share their cells: what table 10 has
calibrated, table 1 learns policies at.
"""

import argparse
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import costs
import figure_2
import numpy as np
from kept import CALIBRATIONS, RESULTS, Study, commits
from paper_cells import (
    ERRORS,
    STUDIES,
    Place,
    as_asked,
    chain_of,
    how_far,
    in_words,
    kept,
    planned,
    printed,
    table_of_errors,
    wanted,
)
from pooling import OUR_LOGS

from madoc.suites.cells import Cell, Kind
from madoc.suites.results import Result, results_of
from madoc.suites.standing import Standing

PAGE = RESULTS / "paper.md"
RETURNS = {
    "table-1": "Table 1: normalized return, D4RL's qualities",
    "table-2": "Table 2: normalized return, NeoRL's qualities",
    "table-13": "Table 13: normalized return with cloning",
    "figure-3b": "Figure 3b: normalized return by the number of calibrated parameters",
    "figure-4": "Figures 4 and 8: normalized return by rows and ranges",
    "figure-6": "Figure 6: normalized return with groups and without",
}
OWN = {"table-3": costs, "figure-2": figure_2}
"""Modules of what is no table of scores; each has `TITLE`, `cells`, `told` and `table`."""
TITLES = ERRORS | RETURNS | {name: module.TITLE for name, module in OWN.items()}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--collect", type=Path, help="folder of the suites, whose ended cells are kept")
    arguments = parser.parse_args()
    if arguments.collect:
        for name in TITLES:
            print(f"{name}: {collect(name, arguments.collect)} cells kept")
    else:
        PAGE.write_text(tables())
        print(tables())


def collect(name: str, folder: Path) -> int:
    """Keep what the cells of a suite have found and no earlier call has kept: how many."""
    plan, own = planned(name), OWN.get(name)
    count = 0
    for result in results_of(Standing(folder, list(plan.cells), workers=1), folder):
        if result.status in ("not run", "failed"):
            continue
        if result.cell.kind == "calibrate":
            row = as_asked(chain_of(result.cell, plan))
            count += keep(CALIBRATIONS, row, lambda result=result: of_calibration(result))
        if result.cell.kind == "evaluate":
            count += keep(STUDIES["returns"], {"cell": result.cell.name}, lambda result=result: of_policy(result))
        if own and result.cell in own.cells(plan):
            of_own = lambda result=result: own.told(result, folder)  # noqa: E731
            count += keep(STUDIES[name], {"cell": result.cell.name}, of_own)
    return count


def keep(study: Study, cell: Mapping, found: Callable[[], Mapping]) -> bool:
    """Add what was found of a cell to a study, unless it has a row: whether it was added."""
    if study.has(cell):
        return False
    study.add({**found(), **cell})
    return True


def of_calibration(result: Result) -> dict:
    """What is kept of a calibration: the whole result, or the sentence of a refusal."""
    return {"refusal": result.sentence} if result.calibration is None else result.calibration.to_json()


def of_policy(result: Result) -> dict:
    """What is kept of an evaluation: a return, or the sentence of a refusal."""
    if result.evaluation is None:
        return {"value": None, "refusal": result.sentence}
    (returns,) = result.evaluation.policies.values()
    return {"value": returns["normalized"], "return": returns["return"]}


def tables() -> str:
    """All tables, as Markdown."""
    head = (
        "# The paper's tables\n\nMade by `python benchmarks/paper.py`; in brackets, as printed. "
        "Errors are means over logs, where seeds of a log are averaged first; of several budgets the one that was run "
        "last is shown, with its number where it is not 300,000 control steps. "
        "[Figure 3a](../../docs/concepts/groups.svg) is by `benchmarks/embedding.py`.\n"
    )
    return "\n".join([head, *(f"## {TITLES[name]}\n\n{table(name)}" for name in TITLES)])


def table(name: str) -> str:
    """One table without its title."""
    if name in OWN:
        return OWN[name].table(name)
    return table_of_errors(name) if name in ERRORS else table_of_returns(name)


def table_of_returns(name: str) -> str:
    """Normalized returns by task and system, the mean over seeds, beside the printed ones."""
    plan, found = planned(name), kept(name)
    told = how_far(name, wanted(plan))
    values = defaultdict[Place, list](list)
    for cell in wanted(plan):
        values[place(chain_of(cell, plan))].append(found.get(cell.name, {}))
    if not any(each for rows in values.values() for each in rows):
        return f"{told}.\n"
    rows, columns = (list(dict.fromkeys(each[index] for each in values)) for index in (0, 1))
    lines = [f"{told}. Mean over seeds. {OUR_LOGS}\n", f"| task | {' | '.join(columns)} | commits |"]
    lines.append("|---" * (2 + len(columns)) + "|")
    for row in rows:
        cells = [_returned(values.get((row, column), []), printed(name, row, column)) for column in columns]
        measured = [each for column in columns for each in values.get((row, column), []) if each]
        lines.append(f"| {row} | {' | '.join(cells)} | {commits(measured)} |")
    return "\n".join(lines) + "\n"


def _returned(rows: Sequence[Mapping], paper: tuple[float, float] | None) -> str:
    values = [row["value"] for row in rows if row.get("value") is not None]
    told = "refuses" if any("refusal" in row for row in rows) else "not run" if rows else ""
    told = f"{np.mean(values):.1f} ({len(values)} of {len(rows)} seeds)" if values else told
    return told + (f" [{paper[0]:g} ± {paper[1]:g}]" if paper else "")


def place(chain: Mapping[Kind, Cell]) -> Place:
    """Row and column of a policy: the data with what differs in it, and the system of calibrator and learner."""
    calibration, record = chain["calibrate"].asks, chain["record"].asks
    row = str(record["name"])
    row += f", {int(record['transitions']):,} rows" if "transitions" in record else ""
    row += f", {calibration['level']} ranges" if "level" in calibration else ""
    row += f", {in_words(len(calibration['parameters']))}" if calibration.get("parameters") else ""
    method, policy = str(calibration["method"]), chain["learn"].asks
    learner, at = str(policy["method"]), str(policy.get("at", "calibrated"))
    if method != "nominal":
        return row, method if learner == "sac" else f"{method} + {learner}"
    return row, (at if at != "calibrated" else "mid-range") if learner == "sac" else learner


if __name__ == "__main__":
    main()
