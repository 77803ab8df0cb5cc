"""The paper's tables and figures: what their suites have found, beside what the paper prints.

    madoc suite benchmarks/suites/table-10.yaml --out runs/paper       # hours to weeks; may be stopped at any time
    python benchmarks/paper.py --collect runs/paper                    # keeps what has ended in results/paper
    python benchmarks/paper.py                                         # prints the tables, and writes results/paper.md

Suites share their cells: what table 10 has calibrated, table 1 learns policies at.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import costs
import figure_2
import numpy as np
import paper_cells
from jaxtyping import Float
from paper_cells import asked, chain_of, how_far, keep, kept, planned, printed, wanted
from scipy import stats

from calibration import commit
from madoc import tasks
from madoc.suites.cells import Cell, Kind
from madoc.suites.planning import Plan
from madoc.suites.results import Result, results_of
from madoc.suites.standing import Standing

RESAMPLES = 2000
"""Of the bootstrap."""
TITLES = {
    "table-10": "Table 10: mean absolute calibration error, D4RL's qualities",
    "table-11": "Table 11: mean absolute calibration error, NeoRL's qualities",
    "table-1": "Table 1: normalized return, D4RL's qualities",
    "table-2": "Table 2: normalized return, NeoRL's qualities",
    "table-12": "Table 12: normalized return by the kind of credit",
    "table-13": "Table 13: normalized return with cloning",
    "table-3": "Tables 3 and 4: memory, and time by stage",
    "figure-2": "Figure 2: correlation of the critic's value with the absolute error of gravity",
    "figure-3b": "Figure 3b: normalized return by the number of calibrated parameters",
    "figure-3b-errors": "Figure 3b: mean calibration error by the number of parameters, in % of their ranges",
    "groups": "Groups, one agent, and one agent a parameter: mean absolute calibration error",
    "figure-4": "Figures 4 and 8: normalized return by rows and ranges",
    "figure-6": "Figure 6: normalized return with groups and without",
    "figure-7": "Figure 7: normalized return by the number of groups and α",
}
OWN = {"table-3": costs, "figure-2": figure_2}
"""Modules of what is no table of scores; each has `cells`, `told` and `table`."""

MEASURES = {"figure-3b-errors": "percent_of_range"}
"""What is shown of a cell's result, where that is not its `value`: a mean over other parameters has other units."""


@dataclass(frozen=True)
class Score:
    """What a cell of a suite found, and where it stands in its table."""

    row: str
    column: str
    value: float | None
    refused: bool


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--collect", type=Path, help="folder of the suites, whose ended cells are kept")
    arguments = parser.parse_args()
    if arguments.collect:
        for name in TITLES:
            print(f"{name}: {collect(name, arguments.collect)} cells kept")
    else:
        (paper_cells.RESULTS.parent / "paper.md").write_text(tables())
        print(tables())


def collect(name: str, folder: Path) -> int:
    """Keep what the cells of a suite have found, those of earlier calls included: how many."""
    own, plan, earlier = OWN.get(name), planned(name), kept(name)
    cells = [cell for cell in (own.cells if own else wanted)(plan) if cell.name not in earlier]
    found = {
        result.cell.name: (own.told(result, folder) if own else told(result)) | {"commit": commit()}
        for result in results_of(Standing(folder, cells, workers=1), folder)
        if result.status not in ("not run", "failed")
    }
    if found:
        keep(name, found)
    return len((earlier | found).keys() & {cell.name for cell in (own.cells if own else wanted)(plan)})


def told(result: Result) -> dict:
    """What is kept of a result: a number or the sentence of a refusal, and its cost."""
    if result.calibration is not None:
        error = result.error.get("mean_absolute")
        percent = result.error.get("mean_percent_of_range")
        cost = {"control_steps": result.calibration.control_steps, "seconds": result.calibration.seconds}
        return {"value": error, "percent_of_range": percent} | cost
    if result.evaluation is not None:
        (returns,) = result.evaluation.policies.values()
        return {"value": returns["normalized"], "return": returns["return"]}
    return {"value": None, "refusal": result.sentence}


def tables() -> str:
    """All tables, as Markdown."""
    head = (
        "# The paper's tables\n\nMade by `python benchmarks/paper.py`; in brackets, as printed. "
        "A calibration here learns from at most 300,000 control steps, the paper's from 1,000,000; grouping, "
        "where there is any, takes up to 60,000 more. [Figure 3a](../../docs/concepts/groups.svg) is by "
        "`benchmarks/embedding.py`.\n"
    )
    return "\n".join([head, *(f"## {TITLES[name]}\n\n{table(name)}" for name in TITLES)])


def beside_printed(column: str) -> list[tuple[str, float, float, int]]:
    """Of each task of tables 10 and 11: its name, our mean error over the seeds run, the printed one, and our seeds."""
    found = []
    for name in ("table-10", "table-11"):
        for (row, system), values in by_seed(name).items():
            if system == column and values:
                theirs = printed(name, row, column)
                assert theirs is not None
                found.append((row, float(np.mean(list(values.values()))), theirs[0], len(values)))
    return found


def by_seed(name: str) -> dict[tuple[str, str], dict[int, float]]:
    """Values of a suite by row and column, those of each seed; empty where none was run."""
    plan, found = planned(name), kept(name)
    values = defaultdict[tuple[str, str], dict[int, float]](dict)
    for cell in wanted(plan):
        known = values[place(chain_of(cell, plan))]
        if found.get(cell.name, {}).get("value") is not None:
            known[asked(cell).get("seed", 0)] = found[cell.name]["value"]
    return dict(values)


def table(name: str) -> str:
    """One table without its title: ours beside the printed value, cells that were not run, and their command."""
    if name in OWN:
        return OWN[name].table(name)
    plan = planned(name)
    scores = scores_of(plan, kept(name))
    rows = list(dict.fromkeys(score.row for score in scores))
    columns = list(dict.fromkeys(score.column for score in scores))
    by_cell = defaultdict[tuple[str, str], list[Score]](list)
    for score in scores:
        by_cell[score.row, score.column].append(score)
    lines = [f"{how_far(name, wanted(plan))}. Interquartile mean over seeds (the paper's mean, over 6 seeds).\n"]
    lines += [f"| task | {' | '.join(columns)} |", "|---" * (1 + len(columns)) + "|"]
    for row in rows:
        cells = [_shown(by_cell[row, column], printed(name, row, column)) for column in columns]
        lines.append(f"| {row} | {' | '.join(cells)} |")
    over = [_over_tasks([by_cell[row, column] for row in rows]) for column in columns]
    if any(over):
        lines.append(f"| interquartile mean [95 %] | {' | '.join(over)} |")
    return "\n".join(lines) + "\n"


def scores_of(plan: Plan, found: Mapping[str, Mapping]) -> list[Score]:
    """Every cell that a suite asks for, with its place in the table and what it found."""
    counted = any("parameters" in asked(cell) for cell in plan.cells if cell.kind == "calibrate")
    measure = MEASURES.get(plan.name, "value")
    scores = []
    for cell in wanted(plan):
        chain = chain_of(cell, plan)
        known = found.get(cell.name, {})
        row, column = place(chain)
        count = parameters(chain["calibrate"])
        row += f", {count} parameter{'s' * (count > 1)}" if counted else ""
        scores.append(Score(row, column, known.get(measure), "refusal" in known))
    return scores


def place(chain: Mapping[Kind, Cell]) -> tuple[str, str]:
    """Row and column of a cell: the data with what differs in it, and the system of calibrator and learner."""
    calibration, record = asked(chain["calibrate"]), asked(chain["record"])
    row = str(record["name"])
    if "transitions" in record:
        row += f", {int(record['transitions']):,} rows"
    if "level" in calibration:
        row += f", {calibration['level']} ranges"
    method = str(calibration["method"])
    column = " ".join([method, *(text for group in calibration.get("set", []) for text in group)])
    if "learn" not in chain:
        return row, column
    policy = asked(chain["learn"])
    learner, at = str(policy["method"]), str(policy.get("at", "calibrated"))
    if method != "nominal":
        return row, column if learner == "sac" else f"{column} + {learner}"
    return row, (at if at != "calibrated" else method) if learner == "sac" else learner


def parameters(calibration: Cell) -> int:
    """How many parameters a cell calibrates: those that it names, or all of the robot's."""
    told = asked(calibration)
    return len(told.get("parameters") or tasks.make(told["task"]).parameters)


def interquartile_mean(*rows: Float[np.ndarray, "*resamples seeds"], axis: int = -1) -> Float[np.ndarray, "*resamples"]:
    """Mean of the middle half of all values of several tasks."""
    return stats.trim_mean(np.concatenate(rows, axis=axis), 0.25, axis=axis)


def stratified_interval(tasks: Sequence[Sequence[float]]) -> tuple[float, float]:
    """95 % interval of the interquartile mean: seeds are drawn with replacement within each task (a stratum)."""
    drawn = stats.bootstrap(
        [np.asarray(values) for values in tasks],
        interquartile_mean,
        n_resamples=RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    return float(drawn.confidence_interval.low), float(drawn.confidence_interval.high)


def _shown(scores: Iterable[Score], paper: tuple[float, float] | None) -> str:
    """A cell of a table: ours, of fewer seeds than asked with their number, and in brackets what is printed."""
    listed = list(scores)
    values = [score.value for score in listed if score.value is not None]
    told = "" if not listed else "refuses" if all(score.refused for score in listed) else "not run"
    if values:
        told = f"{float(interquartile_mean(np.array(values))):.3g}"
        told += "" if len(values) == len(listed) else f" ({len(values)} of {len(listed)} seeds)"
    return told + (f" [{paper[0]:g} ± {paper[1]:g}]" if paper else "")


def _over_tasks(cells: Sequence[Sequence[Score]]) -> str:
    """The interquartile mean over all tasks, once each has at least two seeds."""
    tasks = [[score.value for score in scores if score.value is not None] for scores in cells if scores]
    if not tasks or min(map(len, tasks)) < 2:
        return ""
    low, high = stratified_interval(tasks)
    return f"{float(interquartile_mean(*map(np.asarray, tasks))):.3g} [{low:.3g}, {high:.3g}]"


if __name__ == "__main__":
    main()
