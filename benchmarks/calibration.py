"""Calibration error of a method on recorded data: one JSON file a run, those already there are skipped.

    python benchmarks/calibration.py --robots hopper halfcheetah --starts logged policy --seeds 0 1 2

`python benchmarks/tables.py calibration` prints the medians.
"""

import argparse
import json
import subprocess
import time
from pathlib import Path

import jax

from madoc import tasks
from madoc.calibration import CALIBRATORS, CalibrationProblem, calibrate
from madoc.data import load, save
from madoc.data.dataset import Dataset
from madoc.policies.behaviours import record_quality
from madoc.simulation.cpu import CpuSimulator

RESULTS = Path(__file__).parent / "results" / "calibration"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", nargs="+", default=["hopper", "halfcheetah", "walker2d", "ant"])
    parser.add_argument("--quality", default="medium")
    parser.add_argument("--methods", nargs="+", default=["madoc"])
    parser.add_argument("--starts", nargs="+", default=["logged", "policy"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--budget", type=int, default=300_000)
    parser.add_argument("--transitions", type=int, default=200_000)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--data", type=Path, default=Path("runs/benchmark-data"))
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    revision = commit()
    arguments.results.mkdir(parents=True, exist_ok=True)
    for robot in arguments.robots:
        simulator = CpuSimulator(tasks.make(robot, "legacy"), threads=arguments.threads)
        dataset = recorded(simulator, arguments.quality, arguments.transitions, arguments.data)
        problem = CalibrationProblem(dataset, simulator)
        for seed in arguments.seeds:
            for starts in arguments.starts:
                for method in arguments.methods:
                    name = f"{robot}-{arguments.quality}-{method}-{starts}-{arguments.budget}-{seed}.json"
                    path = arguments.results / name
                    if path.exists():
                        continue
                    started = time.monotonic()
                    result = calibrate(
                        CALIBRATORS[method].make(starts=starts),
                        problem,
                        key=jax.random.key(seed),
                        budget=arguments.budget,
                        truth=dataset.true_parameters,
                    )
                    row = result.to_json() | {
                        "commit": revision,
                        "starts": starts,
                        "quality": arguments.quality,
                        "transitions": len(dataset),
                        "wall_seconds": round(time.monotonic() - started, 1),
                    }
                    path.write_text(json.dumps(row, indent=1) + "\n")
                    print(path.name, row["error"]["mean_absolute"], row["wall_seconds"], flush=True)


def recorded(simulator: CpuSimulator, quality: str, transitions: int, folder: Path) -> Dataset:
    """The benchmark's dataset, recorded once with seed 0."""
    path = folder / f"{simulator.task.name}-{quality}-{transitions}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        save(record_quality(simulator, quality, transitions=transitions, key=jax.random.key(0)), path)
    return load(path, simulator.task)


def commit() -> str:
    """The revision measured, with a + if tracked files had changes."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], capture_output=True, text=True, check=True).stdout.strip()

    sources = ("src", "benchmarks/*.py")
    return git("rev-parse", "--short", "HEAD") + "+" * bool(git("status", "--porcelain", "-uno", "--", *sources))


if __name__ == "__main__":
    main()
