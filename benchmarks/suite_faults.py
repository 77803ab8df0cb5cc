"""A suite whose workers are killed, and then the suite itself: every result must be that of an undisturbed run.

    python benchmarks/suite_faults.py                        # workers of this machine
    python benchmarks/suite_faults.py --executor ray         # a Ray cluster of three worker processes
    python benchmarks/suite_faults.py --executor ray-nodes   # a Ray cluster of three nodes, of which one is killed

Forty short calibrations of the spring; 20 times SIGKILL to a random worker at a random moment, then to the suite.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from kept import RESULTS, Study

ROOT = Path(__file__).parents[1]
STUDY = Study(RESULTS / "suite.jsonl", ("what",))
"""What suites have shown: one row for each way to look at them, by the three benchmarks of their name."""
SUITE = """\
madoc: 1
cells:
  - task: {spec}
    data: logs
    method: least-squares
    budget: 20000
    holdout: 0.5
    grid: {{seed: 0..{last}}}
"""
RAY = ("ray", "ray-nodes")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--executor", choices=["local", *RAY], default="local")
    parser.add_argument("--cells", type=int, default=40)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--results", type=Path, default=STUDY.file)
    parser.add_argument("--undisturbed", type=Path, help="folder of an undisturbed run, made there if it is missing")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        suite = written(folder, arguments.cells)
        whole = arguments.undisturbed or folder / "whole"
        undisturbed = finished(suite, whole) if not whole.exists() else None
        started = time.monotonic()
        with cluster(arguments.executor) as (options, raylets):
            told = disturbed(suite, folder / "killed", options, raylets, arguments)
        told |= {
            "executor": arguments.executor,
            "seconds_undisturbed": undisturbed,
            "seconds_disturbed": round(time.monotonic() - started, 1),
            "load": round(os.getloadavg()[1], 1),
            "command": " ".join(["python benchmarks/suite_faults.py", *sys.argv[1:]]),
        } | compared(whole, folder / "killed")
    replace(STUDY, file=arguments.results).add({"what": f"faults-{arguments.executor}"} | told)
    print(json.dumps(told, indent=1))


def written(folder: Path, cells: int) -> Path:
    """A suite file, with the spring's logs beside it."""
    spring = ROOT / "examples" / "spring"
    words = [ROOT / "examples" / "record_logs.py", spring / "spring.yaml", spring / "truth.json", folder / "logs"]
    subprocess.run([sys.executable, *words, "--runs", "2"], check=True, stdout=subprocess.DEVNULL)
    suite = folder / "suite.yaml"
    suite.write_text(SUITE.format(spec=spring / "spring.yaml", last=cells - 1))
    return suite


def started_suite(suite: Path, out: Path, *options: str) -> subprocess.Popen:
    words = [sys.executable, "-m", "madoc", "suite", str(suite), "--out", str(out), "--quiet", *options]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL)


def finished(suite: Path, out: Path, *options: str) -> float:
    """Run a suite to its end: seconds."""
    began = time.monotonic()
    assert started_suite(suite, out, *options).wait() == 0
    return round(time.monotonic() - began, 1)


def disturbed(suite: Path, out: Path, options: list[str], raylets: list[int], arguments: argparse.Namespace) -> dict:
    """Kill workers, a node where there are several, then the suite, and let it go on to its end."""
    moments = random.Random(arguments.seed)
    process = started_suite(suite, out, *options)
    killed = 0
    in_cell = 0
    while killed < arguments.kills and process.poll() is None:
        while process.poll() is None and not any(map(holds_cell, workers_of(process, raylets))):
            time.sleep(0.1)  # so that a kill comes while something is done
        time.sleep(moments.uniform(0.0, 3.0))
        if workers := workers_of(process, raylets):
            victim = moments.choice(workers)
            in_cell += holds_cell(victim)
            os.kill(victim, signal.SIGKILL)
            killed += 1
    node_killed = bool(raylets)
    if raylets:
        os.kill(raylets.pop(), signal.SIGKILL)
        time.sleep(5.0)
    ended = len(list(out.glob("cells/*/outcome.json")))
    children = descendants(process.pid)
    process.kill()
    process.wait()
    time.sleep(10.0)
    orphans = [pid for pid in children if Path(f"/proc/{pid}").exists() and is_worker(pid)]
    finished(suite, out, *options)
    return {
        "cells": arguments.cells,
        "workers_killed": killed,
        "of_them_within_a_cell": in_cell,
        "node_killed": node_killed,
        "ended_when_the_suite_was_killed": ended,
        "workers_left_10_s_after": len(orphans),
    }


def compared(whole: Path, killed: Path) -> dict:
    """How many cells have a result, and how many have the bits of the undisturbed run."""
    names = sorted(path.parent.name for path in whole.glob("cells/*/outcome.json"))
    same = sum(bits(whole / "cells" / name) == bits(killed / "cells" / name) for name in names)
    attempts = [json.loads(path.read_text())["attempts"] for path in killed.glob("cells/*/outcome.json")]
    return {"results": len(attempts), "equal_bits": same, "most_attempts": max(attempts)}


def bits(folder: Path) -> tuple:
    """What a calibration found, without seconds: its result, its log, and the windows that show it."""
    result = json.loads((folder / "result.json").read_text())
    del result["seconds"], result["judging_seconds"]
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    with np.load(folder / "evidence.npz") as arrays:
        evidence = {name: arrays[name].tobytes() for name in arrays}
    return result, [(line["control_steps"], line["metrics"]) for line in lines], evidence


def descendants(pid: int) -> list[int]:
    """Processes below another one."""
    found = []
    for file in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            children = [int(word) for word in file.read_text().split()]
        except OSError:
            continue
        found += [*children, *(below for child in children for below in descendants(child))]
    return found


def is_worker(pid: int) -> bool:
    """Whether a process does cells: one of `madoc worker`, or a task of Ray."""
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ")
    except OSError:
        return False
    return b"madoc worker" in words or b"ray::do_cell" in words


def workers_of(process: subprocess.Popen, raylets: list[int]) -> list[int]:
    """The processes that do the cells of a suite."""
    return [pid for root in (process.pid, *raylets) for pid in descendants(root) if is_worker(pid)]


def holds_cell(pid: int) -> bool:
    """Whether a process has the lock of a cell open."""
    try:
        return any(".claim" in os.readlink(file) for file in Path(f"/proc/{pid}/fd").iterdir())
    except OSError:
        return False


@contextmanager
def cluster(executor: str) -> Iterator[tuple[list[str], list[int]]]:
    """The options of a suite, and the processes of the nodes of a cluster that outlives it."""
    if executor != "ray-nodes":
        yield (["--executor", "ray", "--workers", "3"] if executor == "ray" else []), []
        return
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled", "RAY_worker_niceness": "0"}
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    try:
        nodes = [made.add_node(num_cpus=1) for _ in range(3)]
        raylets = [node.all_processes["raylet"][0].process.pid for node in nodes]
        yield ["--executor", "ray", "--address", made.address], raylets
    finally:
        made.shutdown()


if __name__ == "__main__":
    main()
