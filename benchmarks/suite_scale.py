"""What a suite costs besides its cells: plans of ten thousand, and workers beside runs by hand.

python benchmarks/suite_scale.py plan          # list, forecast and claim among 10 000 cells
python benchmarks/suite_scale.py efficiency    # two workers, one worker, and two loops of single runs by hand
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, replace
from pathlib import Path
from statistics import median

from suite_faults import STUDY, written

from madoc.suites.cells import Cell, read_plans, write_plan
from madoc.suites.claims import Outcome, claimed
from madoc.suites.planning import plan_of
from madoc.suites.worker import work

CELLS = 10_000


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["plan", "efficiency"])
    parser.add_argument("--cells", type=int, default=12, help="of the efficiency")
    parser.add_argument("--results", type=Path, default=STUDY.file)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        told = plan(Path(temporary)) if arguments.what == "plan" else efficiency(Path(temporary), arguments.cells)
        told |= {
            "load": round(os.getloadavg()[1], 1),
            "command": f"python benchmarks/suite_scale.py {arguments.what}",
        }
        replace(STUDY, file=arguments.results).add({"what": arguments.what} | told)
        print(json.dumps(told, indent=1), flush=True)


def plan(folder: Path) -> dict:
    """Seconds and memory to list and forecast many cells, and to claim one of them."""
    suite, out = written(folder, CELLS), folder / "out"
    empty = listed(suite, out)
    cells = plan_of(suite).cells
    write_plan(out, "suite", cells)
    for cell in cells[: CELLS // 10]:
        pretend(cell, out)
    some = listed(suite, out)
    claims = []
    for cell in cells[CELLS // 10 :][:200]:
        started = time.perf_counter()
        with claimed(cell, out) as claim:
            claims.append(time.perf_counter() - started)
            assert claim is not None
    for cell in cells[CELLS // 10 : -1]:
        pretend(cell, out)
    with claimed(cells[-1], out):  # held, so that a worker looks at all and begins none
        started = time.perf_counter()
        assert work(out) == []
        last = time.perf_counter() - started
    started = time.perf_counter()
    read_plans(out)
    return {
        "cells": CELLS,
        "listing_s": empty,
        "listing_and_forecast_s": some,
        "claim_ms_median": round(1e3 * median(claims), 2),
        "claim_ms_largest": round(1e3 * max(claims), 2),
        "reading_the_plan_s": round(time.perf_counter() - started, 2),
        "worker_from_start_to_the_last_of_all_s": round(last, 2),
    }


def pretend(cell: Cell, out: Path) -> None:
    """Leave the outcome of a cell that was never begun."""
    folder = cell.folder(out)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "outcome.json").write_text(json.dumps(asdict(Outcome("finished", "done", 2.0, 1, "here"))))


def listed(suite: Path, out: Path) -> dict:
    """A dry run in a process of its own: seconds on the wall and of its core, and its largest memory."""
    words = [sys.executable, "-m", "madoc", "suite", str(suite), "--out", str(out), "--dry-run"]
    started = time.monotonic()
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
    # Not ru_maxrss: a process inherits that of the one that starts it.
    memory, ended = 0, 0
    while not ended:
        file = Path(f"/proc/{process.pid}/status").read_text()
        memory = max([memory, *(int(line.split()[1]) for line in file.splitlines() if line.startswith("VmHWM"))])
        time.sleep(0.02)
        ended, status, used = os.wait4(process.pid, os.WNOHANG)
    assert status == 0
    return {
        "wall_s": round(time.monotonic() - started, 2),
        "core_s": round(used.ru_utime + used.ru_stime, 2),
        "memory_mb": round(memory / 1024),
    }


def efficiency(folder: Path, cells: int) -> dict:
    """Seconds of the same calibrations by two workers, by one, and by two loops of single runs."""
    suite = written(folder, cells)
    timed = {}
    for workers in (2, 1):
        words = ["suite", str(suite), "--out", str(folder / f"by-{workers}"), "--workers", str(workers), "--quiet"]
        timed[f"workers_{workers}"] = seconds_of([[words]])
    orders = [
        [
            *("calibrate", str(Path(__file__).parents[1] / "examples" / "spring" / "spring.yaml")),
            *("--data", str(folder / "logs"), "--method", "least-squares", "--budget", "20000", "--holdout", "0.5"),
            *("--seed", str(seed), "--out", str(folder / f"hand-{seed}"), "--quiet"),
        ]
        for seed in range(cells)
    ]
    timed["two_loops_by_hand"] = seconds_of([orders[::2], orders[1::2]])
    wall = {name: row["wall_s"] for name, row in timed.items()}
    return {
        "cells": cells,
        **timed,
        "two_workers_against_by_hand": round(wall["two_loops_by_hand"] / wall["workers_2"], 2),
        "two_workers_against_twice_one": round(wall["workers_1"] / (2 * wall["workers_2"]), 2),
    }


def seconds_of(loops: list[list[list[str]]]) -> dict:
    """Run loops of commands side by side: seconds on the wall, and of all cores."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    started = time.monotonic()
    script = "import subprocess, sys, json\nfor words in json.loads(sys.argv[1]):\n"
    script += " subprocess.run([sys.executable, '-m', 'madoc', *words], stdout=subprocess.DEVNULL)"
    running = [subprocess.Popen([sys.executable, "-c", script, json.dumps(loop)]) for loop in loops]
    assert [process.wait() for process in running] == [0] * len(running)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    core = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"wall_s": round(time.monotonic() - started, 1), "core_s": round(core, 1)}


if __name__ == "__main__":
    main()
