"""Many pendulums of one kind, each with parameters of its own: what the suite says they share, beside what was planted.

    python benchmarks/suite_fleet.py --robots 200

Each is logged for 24 s with noisy sensors and calibrated by least squares; two of them are given other bearings.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from suite_faults import ROOT, STUDY

from madoc import robots

sys.path.insert(0, str(ROOT / "examples"))
from record_logs import record

SPEC = ROOT / "examples" / "pendulum" / "pendulum.yaml"
MEAN = {"length": 0.5, "damping": 0.15, "friction": 0.3, "gain": 1.0}
SPREAD = {"length": 0.01, "damping": 0.015, "friction": 0.03, "gain": 0.02}
"""Mean and standard deviation of what is planted, in the parameters' units."""
ODD = {3: {"damping": 0.3}, 7: {"friction": 0.6}}
"""Robots, by number, that do not belong, and in what."""
RUNS, SECONDS, NOISE = 4, 6.0, 0.005
SUITE = """\
madoc: 1
cells:
  - task: {spec}
    robots: robots/*
    method: least-squares
    holdout: 0.25
"""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", type=int, default=200)
    parser.add_argument("--results", type=Path, default=STUDY.file)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        told = calibrated(Path(temporary), arguments.robots)
    told |= {
        "robots": arguments.robots,
        "load": round(os.getloadavg()[1], 1),
        "command": " ".join(["python benchmarks/suite_fleet.py", *sys.argv[1:]]),
    }
    replace(STUDY, file=arguments.results).add({"what": "fleet"} | told)
    print(json.dumps(told, indent=1))


def planted(folder: Path, count: int) -> dict[str, dict[str, float]]:
    """Logs of so many pendulums: the true parameters of each by its name."""
    robot, random = robots.load(SPEC), np.random.default_rng(0)
    truths = {}
    for number in range(count):
        truth = {name: float(MEAN[name] + SPREAD[name] * random.standard_normal()) for name in MEAN}
        truth |= ODD.get(number, {})
        place = folder / "robots" / f"pendulum-{number:03d}"
        place.mkdir(parents=True)
        rows = round(SECONDS / robot.spec.control_step)
        for run, columns in enumerate(record(robot, truth, rows, runs=RUNS, noise=NOISE, random=random)):
            own = {robot.spec.log.columns.get(name, name): values for name, values in columns.items()}
            table = np.stack(list(own.values()), -1)
            np.savetxt(place / f"run_{run}.csv", table, "%.9g", ",", header=",".join(own), comments="")
        truths[place.name] = truth
    return truths


def calibrated(folder: Path, count: int) -> dict:
    """The fleet's suite from file to report: its time, and what it found beside what was planted."""
    truths = planted(folder, count)
    suite, out = folder / "fleet.yaml", folder / "out"
    suite.write_text(SUITE.format(spec=SPEC))
    words = [sys.executable, "-m", "madoc", "suite", str(suite), "--out", str(out), "--workers", "2"]
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    wall, after = time.monotonic() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
    reporting = time.monotonic()
    subprocess.run([*words, "--report"], check=True, stdout=subprocess.DEVNULL)
    (fleet,) = json.loads((out / "fleet-fleet.json").read_text())
    core = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    verdicts = {name: reason.partition(":")[0] for name, reason in fleet["left_out"].items()}
    return {
        "wall_s": round(wall, 1),
        "core_s": round(core, 1),
        "minutes_if_two_cores_were_free": round(core / 2 / 60, 1),
        "report_s": round(time.monotonic() - reporting, 1),
        "not_calibrated": {word: list(verdicts.values()).count(word) for word in set(verdicts.values())},
        "planted_odd": {f"pendulum-{number:03d}": list(changed) for number, changed in ODD.items()},
        "parameters": {row["name"]: compared(row, fleet["ranges"], truths) for row in fleet["parameters"]},
    }


def compared(row: dict, ranges: dict, truths: dict) -> dict:
    """What the report says of one parameter, beside what was planted."""
    name, shared = row["name"], row["common"]
    ordinary = [truth[name] for robot, truth in truths.items() if robot in row["robots"]]
    low, high = ranges[name]
    return {
        "robots": len(row["robots"]),
        "mean": shared["mean"],
        "mean_planted": MEAN[name],
        "interval_holds_it": shared["interval"][0] <= MEAN[name] <= shared["interval"][1],
        "spread": shared["spread"],
        "spread_planted": SPREAD[name],
        "range": [low, high],
        "share_of_robots_within": round(float(np.mean([low <= value <= high for value in ordinary])), 3),
        "outliers": row["outliers"],
    }


if __name__ == "__main__":
    main()
