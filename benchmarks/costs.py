"""Tables 3 and 4 of the paper: the memory that methods hold, and their time by stage.

    python benchmarks/costs.py --out runs/costs            # the cells of table 3, each in a process of its own
    python benchmarks/paper.py --collect runs/costs

`madoc suite` does the same cells with a few processes. What one has compiled for a cell it keeps, so the memory of its
later cells is only known to be at most what they tell. To collect a cell again, delete its line in
results/table-3.jsonl.
"""

import argparse
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from paper_cells import chain_of, how_far, kept, planned, printed_number, wanted

from madoc.report.reading import read_metrics
from madoc.suites.cells import Cell, write_plan
from madoc.suites.claims import outcome_of
from madoc.suites.planning import Plan
from madoc.suites.results import Result

TITLE = "Tables 3 and 4: memory, and time by stage"
PRINTED = {"cloning": "", "calibrating": "calibration", "exploring": "", "fitting": "", "opposing": "dynamics reward"}
"""What the paper calls a stage, and nothing where it tells no time of it; all others have our name there too."""

ALONE = """
import sys
from pathlib import Path
from madoc.runs.machine import prepare_worker
suite, name = Path(sys.argv[1]), sys.argv[2]
prepare_worker()
from madoc.suites.worker import work
work(suite, [name])
"""
"""A process that does one cell, as a worker does many."""

Costs = Sequence[Mapping]
"""What is kept of the same cell under several seeds."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True, help="folder of the suite")
    run(planned("table-3"), parser.parse_args().out)


def run(plan: Plan, out: Path) -> None:
    """Do the cells of a plan one after another, each in a process of its own; those that have ended are left alone."""
    write_plan(out, plan.name, plan.cells)
    for cell in plan.cells:
        if outcome_of(cell, out) is None:
            subprocess.run([sys.executable, "-c", ALONE, str(out), cell.name], check=True)
            outcome = outcome_of(cell, out)
            print(cell.kind, cell.name, "not run" if outcome is None else outcome.status, flush=True)


def cells(plan: Plan) -> list[Cell]:
    """The cells whose cost counts: policies, and the calibrations they need; `nominal` does nothing."""
    chains = [chain_of(cell, plan) for cell in wanted(plan)]
    every = [chain[kind] for chain in chains for kind in ("calibrate", "learn")]
    return [cell for cell in every if cell.asks["method"] != "nominal"]


def told(result: Result, folder: Path) -> dict:
    """What is kept of a result: its peak of memory in bytes, and seconds, epochs and budget spent by stage.

    `alone` says whether it was the first cell of its process.
    """
    log = read_metrics(result.cell.folder(folder) / "metrics.jsonl")
    if log is None or (result.calibration is None and not result.learnt):
        return {"refusal": result.sentence}
    stages = {
        name: {"seconds": round(stage.seconds, 3), "epochs": stage.epochs, "spent": round(stage.spent)}
        for name, stage in log.by_stage().items()
    }
    outcome = outcome_of(result.cell, folder)
    memory = {"peak_memory": result.peak_memory, "alone": outcome is not None and outcome.fresh}
    return memory | {"unit": log.unit, "stages": stages}


def table(name: str) -> str:
    """Both tables, as Markdown without their title."""
    plan, found = planned(name), kept(name)
    methods = _by_method(plan, found)
    lines = [
        f"{how_far(name, cells(plan))}. Means over seeds.\n",
        "Table 3: the largest resident memory of the process while epochs ran, in MB, with Python, its libraries, "
        "the log and what is compiled; `at most` where the process had done other cells before (`benchmarks/costs.py` "
        "gives each its own). In brackets the GPU memory that the paper prints, which is another thing.\n",
        "| method | calibration | policy |",
        "|---|---|---|",
        *(f"| {method} | {_memory(parts, method)} |" for method, parts in methods.items()),
        "\nTable 4: wall-clock time, ours on one core of a CPU and the paper's with a GPU. An epoch of the paper's "
        "calibration has 1,000 control steps and as many updates; of ours see the columns.\n",
        "| method | stage | s | epochs | s an epoch | s per 1,000 steps or updates | printed |",
        "|---|---|---|---|---|---|---|",
        *(line for method, parts in methods.items() for line in _times(parts, method)),
    ]
    return "\n".join(lines) + "\n"


def _by_method(plan: Plan, found: Mapping[str, Mapping]) -> dict[str, dict[str, list[Mapping]]]:
    """What is kept of each method's cells by their kind, a list over seeds; a cell without cost is left out."""
    methods: dict[str, dict[str, list[Mapping]]] = {}
    counted = {cell.name for cell in cells(plan)}
    for cell in wanted(plan):
        chain = chain_of(cell, plan)
        calibrator, learner = chain["calibrate"].asks["method"], chain["learn"].asks["method"]
        parts = methods.setdefault(learner if calibrator == "nominal" else calibrator, {})
        for kind in ("calibrate", "learn"):
            row = found.get(chain[kind].name, {})
            if chain[kind].name in counted:
                parts.setdefault(kind, []).extend([row] if "stages" in row else [])
    return methods


def _memory(parts: Mapping[str, Costs], method: str) -> str:
    """The cells of a row of table 3."""
    shown = []
    for kind in ("calibrate", "learn"):
        known = [row for row in parts.get(kind, ()) if row["peak_memory"] is not None]
        alone = [row for row in known if row["alone"]]
        none = "" if kind not in parts else "not known" if parts[kind] else "not run"
        mean = np.mean([row["peak_memory"] for row in alone or known]) / 1e6 if known else 0.0
        shown.append(("" if alone else "at most ") + f"{mean:.0f}" if known else none)
    number = printed_number("table-3", method, "memory")
    return " | ".join(shown) + ("" if number is None else f" [{number:g}]")


def _times(parts: Mapping[str, Costs], method: str) -> Iterator[str]:
    """The rows of a method in table 4: a stage each, and their total."""
    total = printed_number("table-4", method, "total")
    known = f"{total:g} h" if total is not None else ""
    if not all(parts.values()):
        yield f"| {method} | all | not run | | | | {known} |"
        return
    sums = []
    for costs in parts.values():
        sums.append(np.mean([sum(stage["seconds"] for stage in row["stages"].values()) for row in costs]))
        for name in dict.fromkeys(name for row in costs for name in row["stages"]):
            seconds, epochs, spent = (
                float(np.mean([row["stages"].get(name, {}).get(key, 0) for row in costs]))
                for key in ("seconds", "epochs", "spent")
            )
            each = f"{1000 * seconds / spent:.3g}" if spent else ""
            theirs = printed_number("table-4", method, PRINTED.get(name, name))
            beside = f"{theirs:g} s an epoch" if theirs is not None else ""
            yield f"| {method} | {name} | {seconds:.3g} | {epochs:.0f} | {seconds / epochs:.3g} | {each} | {beside} |"
    yield f"| {method} | all | {sum(sums):.3g} | | | | {known} |"


if __name__ == "__main__":
    main()
