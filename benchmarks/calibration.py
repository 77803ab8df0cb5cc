"""Calibration error of a method on recorded data: one JSON file a run, those already there are skipped.

    python benchmarks/calibration.py --robots hopper halfcheetah --starts logged policy --seeds 0 1 2
    python benchmarks/calibration.py --robots hopper --methods least-squares oted --data-is noise-1 hidden shuffled-rows

A method that refuses the data leaves its sentence. `python benchmarks/tables.py` prints the medians.
"""

import argparse
import json
import subprocess
import time
from dataclasses import fields
from itertools import product
from pathlib import Path

import jax

from madoc import tasks
from madoc.calibration import CALIBRATORS, CalibrationProblem, calibrate
from madoc.data import Dataset, Disturbance, disturb, load, observed_task, save
from madoc.errors import MadocError
from madoc.policies.behaviours import record_quality
from madoc.simulation.cpu import CpuSimulator
from madoc.tasks import Task

RESULTS = Path(__file__).parent / "results" / "calibration"
DATA = {
    "clean": ("legacy", Disturbance()),
    "noise-1": ("legacy", Disturbance(noise=0.01)),
    "noise-10": ("legacy", Disturbance(noise=0.1)),
    "modern": ("modern", Disturbance()),
    "friction-20": ("legacy", Disturbance(friction=1.2)),
    "hidden": ("legacy", Disturbance(hidden_velocities=True)),
    "shuffled-rows": ("legacy", Disturbance(shuffled="rows")),
    "shuffled-next": ("legacy", Disturbance(shuffled="next_observations")),
}
"""The physics of the target, and how its data is disturbed; always calibrated in legacy physics."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", nargs="+", default=["hopper", "halfcheetah", "walker2d", "ant"])
    parser.add_argument("--quality", default="medium")
    parser.add_argument("--methods", nargs="+", default=["madoc"])
    parser.add_argument(
        "--starts", nargs="+", help="for the methods that have a choice; logged, or policy where velocities are hidden"
    )
    parser.add_argument("--data-is", nargs="+", default=["clean"], choices=list(DATA), help="how it is disturbed")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--budget", type=budget, default=300_000, help="300000, or a time as 60s")
    parser.add_argument("--transitions", type=int, default=200_000)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--folder", type=Path, default=Path("runs/benchmark-data"), help="where recorded data is kept")
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    revision = commit()
    arguments.results.mkdir(parents=True, exist_ok=True)
    for robot, data_is in product(arguments.robots, arguments.data_is):
        task = tasks.make(robot, "legacy")
        dataset = recorded(task, arguments.quality, arguments.transitions, arguments.folder, data_is)
        problem = CalibrationProblem(dataset, CpuSimulator(observed_task(task, dataset), threads=arguments.threads))
        for seed, method in product(arguments.seeds, arguments.methods):
            chosen = has_starts(method)
            for starts in (arguments.starts or [usual_starts(data_is)]) if chosen else ["-"]:
                words = [robot, arguments.quality, method, *([starts] if chosen else []), arguments.budget, seed]
                words += [] if data_is == "clean" else [data_is]
                path = arguments.results / ("-".join(map(str, words)) + ".json")
                if path.exists():
                    continue
                row = {
                    "robot": robot,
                    "quality": arguments.quality,
                    "data": data_is,
                    "transitions": len(dataset),
                    "method": method,
                    "starts": starts,
                    "budget": arguments.budget,
                    "seed": seed,
                    "commit": revision,
                }
                row |= run(method, {"starts": starts} if chosen else {}, problem, dataset, seed, arguments.budget)
                if row.get("status") == "interrupted":
                    return
                path.write_text(json.dumps(row, indent=1) + "\n")
                print(path.name, row["error"]["mean_absolute"] if "error" in row else row["refusal"], flush=True)


def budget(text: str) -> int | str:
    """A count, or a time as Madoc reads it."""
    return int(text) if text.isdigit() else text


def run(method, changes, problem: CalibrationProblem, dataset: Dataset, seed: int, budget: int | str) -> dict:
    """The result of one calibration, or the sentence it is refused with."""
    started = time.monotonic()
    try:
        result = calibrate(
            CALIBRATORS[method].make(**changes),
            problem,
            key=jax.random.key(seed),
            budget=budget,
            truth=dataset.true_parameters,
        )
    except MadocError as refusal:
        return {"refusal": str(refusal)}
    return result.to_json() | {"method": method, "wall_seconds": round(time.monotonic() - started, 1)}


def usual_starts(data_is: str) -> str:
    """Where rollouts start on such data if nothing else is asked: states cannot be rebuilt without velocities."""
    return "policy" if DATA[data_is][1].hidden_velocities else "logged"


def has_starts(method: str) -> bool:
    """Whether a method can choose where its rollouts start."""
    return "starts" in {field.name for field in fields(CALIBRATORS[method].make())}


def recorded(task: Task, quality: str, transitions: int, folder: Path, data_is: str = "clean") -> Dataset:
    """The benchmark's dataset, recorded once with seed 0, then disturbed."""
    physics, disturbance = DATA[data_is]
    name = f"{task.name}-{quality}-{transitions}"
    target = tasks.make(task.name, physics)
    if physics != task.physics:
        name += f"-{physics}"
    if disturbance.friction != 1.0:
        name += f"-friction-{disturbance.friction:g}"
        target = target.with_friction(disturbance.friction)
    path = folder / f"{name}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        made = record_quality(CpuSimulator(target), quality, transitions=transitions, key=jax.random.key(0))
        save(made, path)
    dataset = load(path, task)
    return disturb(dataset, disturbance, task, jax.random.key(1))


def commit() -> str:
    """The revision measured, with a + if tracked files had changes."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], capture_output=True, text=True, check=True).stdout.strip()

    sources = ("src", "benchmarks/*.py")
    return git("rev-parse", "--short", "HEAD") + "+" * bool(git("status", "--porcelain", "-uno", "--", *sources))


if __name__ == "__main__":
    main()
