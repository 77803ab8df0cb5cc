"""Calibration error of a method on recorded data: a row of results/calibration.jsonl each, those already there skipped.

    python benchmarks/calibration.py --tasks hopper-medium --methods madoc least-squares --logs 0 1 2
    python benchmarks/calibration.py --tasks hopper-medium --methods oted --data-is noise-1 hidden shuffled-rows
    python benchmarks/calibration.py --tasks halfcheetah-medium --methods madoc-paper --budget 1000000

Log 0 has the paper's truth. Every other log of a task has a truth of its own, uniform over the middle 80 % of each
range, masses over the middle 80 % of what is positive of it; how it is recorded, how it is disturbed and where the
method begins are drawn anew for each log as well. A method that refuses the data leaves its sentence. A cell that
another process is running is skipped, so the same command may be given several times at once; one that was killed goes
on where it was. `python benchmarks/tables.py` shows them.
"""

import argparse
import hashlib
import json
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import jax
import numpy as np
from filelock import FileLock
from kept import CALIBRATIONS, commit

from madoc import tasks
from madoc.calibration import CALIBRATORS, CalibrationProblem, calibrate
from madoc.calibration.base import Calibrator
from madoc.data import Dataset, Disturbance, disturb, load, observed_task, save
from madoc.errors import MadocError
from madoc.evaluation import calibration_error
from madoc.pipeline.methods import make_method
from madoc.pipeline.orders import parse_settings
from madoc.policies.behaviours import record_quality
from madoc.runs.run_folder import RunFolder
from madoc.simulation.cpu import CpuSimulator
from madoc.tasks import Task

CLEAN = Disturbance()
View = Callable[[Task, Dataset], tuple[Task, Dataset]]
"""From the robot and its disturbed log: the robot as a calibrator is shown it, and the log that it gets."""


def as_observed(task: Task, dataset: Dataset) -> tuple[Task, Dataset]:
    """The log as it is, which declares its noise, and the robot with the observations that are left in it."""
    return observed_task(task, dataset), dataset


def undeclared(task: Task, dataset: Dataset) -> tuple[Task, Dataset]:
    """The same log, which does not tell how much noise it has."""
    return as_observed(task, replace(dataset, disturbance=replace(dataset.disturbance, noise=0.0)))


def by_encoders(task: Task, dataset: Dataset) -> tuple[Task, Dataset]:
    """What joint encoders and an IMU show of a walking robot: neither its height nor its linear velocity.

    The first position of the four robots is the height; of what is behind the positions the first two values, of Ant
    the first three, are the linear velocity. No state can be rebuilt or fitted.
    """
    positions = task.observation_size - task.velocities
    unseen = [0, *(positions + axis for axis in range(3 if task.name == "ant" else 2))]
    seen = np.setdiff1d(np.arange(task.observation_size), unseen)
    rows, observe = dataset.transitions, task.observe
    shown = replace(
        task,
        observation_size=len(seen),
        observe=lambda state: observe(state)[..., seen],
        velocities=0,
        state_from_observation=None,
        rebuildable=None,
        posture=None,
    )
    fewer = replace(rows, observation=rows.observation[:, seen], next_observation=rows.next_observation[:, seen])
    return shown, replace(dataset, transitions=fewer)


@dataclass(frozen=True)
class Kind:
    """How the data of a cell differs from a clean log of the simulator itself.

    Attributes:
        disturbance: What is done to the log; its friction is the target's.
        physics: Of the target. The calibrated simulator is always legacy.
        view: What a calibrator is shown of it.
    """

    disturbance: Disturbance = CLEAN
    physics: str = "legacy"
    view: View = as_observed


KINDS = {
    "clean": Kind(),
    "noise-1": Kind(Disturbance(noise=0.01)),
    "noise-10": Kind(Disturbance(noise=0.1)),
    "noise-1-undeclared": Kind(Disturbance(noise=0.01), view=undeclared),
    "noise-10-undeclared": Kind(Disturbance(noise=0.1), view=undeclared),
    "modern": Kind(physics="modern"),
    "friction-20": Kind(Disturbance(friction=1.2)),
    "hidden": Kind(Disturbance(hidden_velocities=True)),
    "encoders": Kind(view=by_encoders),
    "shuffled-rows": Kind(Disturbance(shuffled="rows")),
    "shuffled-next": Kind(Disturbance(shuffled="next_observations")),
}
"""Kinds of data by name. Another kind is another entry here."""
MEDIUM = ("hopper-medium", "halfcheetah-medium", "walker2d-medium", "ant-medium")
MIDDLE = 0.8
"""Share of each range, about its middle, in which the truths of logs 1 and on lie."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(MEDIUM), help="as hopper-medium-replay")
    parser.add_argument("--methods", nargs="+", default=["madoc"])
    parser.add_argument("--data-is", nargs="+", default=["clean"], choices=list(KINDS))
    parser.add_argument("--logs", nargs="+", type=int, default=[0])
    parser.add_argument("--budget", type=budget, default=300_000, help="control steps, or a time as 60s")
    parser.add_argument("--set", nargs="*", default=[], help="hyperparameters of the methods as name=value")
    parser.add_argument("--transitions", type=int, default=200_000)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--anew", action="store_true", help="run cells again whose row is of another commit")
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/benchmark-data"), help="where logs and unfinished runs are"
    )
    parser.add_argument("--results", type=Path, default=CALIBRATIONS.file)
    arguments = parser.parse_args()
    study, revision = replace(CALIBRATIONS, file=arguments.results), commit()
    settings = parse_settings((tuple(arguments.set),))
    methods = {name: make_method(CALIBRATORS, name, settings) for name in arguments.methods}
    for log, name, data_is in product(arguments.logs, arguments.tasks, arguments.data_is):
        robot, _, quality = name.partition("-")
        asked = {"robot": robot, "quality": quality, "data": data_is, "transitions": arguments.transitions, "log": log}
        asked |= {"seed": log, "budget": arguments.budget} | ({"set": arguments.set} if arguments.set else {})
        given = cache(lambda asked=asked: posed(asked, arguments.folder, arguments.threads))
        for called, method in methods.items():
            cell = {"commit": revision} | asked | {"method": called}
            with study.claimed(cell, revision if arguments.anew else None) as ours:
                if not ours:
                    continue
                found = run(method, *given(), cell=cell, place=arguments.folder / "runs")
                if found.get("status") == "interrupted":
                    return
                study.add(found | cell)
            told = f"{found['error']['mean_absolute']:.3g}" if "error" in found else found["refusal"]
            print(name, data_is, f"log {log}", called, told, f"{found['wall_seconds']:.0f} s", flush=True)


def budget(text: str) -> int | str:
    """A count, or a time as Madoc reads it."""
    return int(text) if text.isdigit() else text


def posed(asked: Mapping[str, Any], folder: Path, threads: int | None) -> tuple[CalibrationProblem, dict[str, float]]:
    """What a calibrator is given of a cell, and the truth, which it is not."""
    task = tasks.make(asked["robot"], "legacy")
    dataset = recorded(
        task, asked["quality"], asked["transitions"], folder, data_is=asked["data"], log=asked["log"], threads=threads
    )
    assert dataset.true_parameters is not None
    shown, data = KINDS[asked["data"]].view(task, dataset)
    return CalibrationProblem(data, CpuSimulator(shown, threads=threads)), dataset.true_parameters


def run(
    method: Calibrator, problem: CalibrationProblem, truth: Mapping[str, float], *, cell: Mapping[str, Any], place: Path
) -> dict[str, Any]:
    """What one calibration found, beside the truth and the error of mid-range; or the sentence it is refused with.

    Where a process was killed at the same commit, it goes on from the last checkpoint, which is kept at the place.
    """
    started, space, key = time.monotonic(), problem.simulator.parameters, jax.random.key(cell["seed"])
    path = place / hashlib.sha256(json.dumps(cell, sort_keys=True).encode()).hexdigest()[:16]
    if cell["commit"].endswith("+"):  # nobody knows whether the sources are still those of the checkpoint
        shutil.rmtree(path, ignore_errors=True)
    resume = (path / "spec.json").exists()
    with RunFolder.open(path, cell) if resume else RunFolder.create(path, cell) as folder:
        try:
            known = {"budget": cell["budget"], "truth": truth, "quiet": True}
            found = calibrate(method, problem, key=key, folder=folder, resume=resume, **known).to_json()
        except MadocError as refusal:
            found = {"refusal": str(refusal)}
    if found.get("status") != "interrupted":
        shutil.rmtree(path)
    error = calibration_error(space.middle, space.vector(truth), space)
    middle = {name: error[name] for name in ("mean_absolute", "mean_percent_of_range")}
    spent = {"wall_seconds": round(time.monotonic() - started, 1)} | ({"resumed": True} if resume else {})
    return found | {"truth": truth, "mid_range": middle} | spent


def planted_truth(task: Task, quality: str, log: int) -> dict[str, float]:
    """The truth of a log but the first, uniform over the middle of each range, of a mass over its positive part."""
    space, random = task.parameters, np.random.default_rng([log, *f"{task.name}-{quality}".encode()])
    low = np.array([max(row.low, 0.0) if row.field == "body_mass" else row.low for row in space.parameters])
    share = random.uniform(0.5 - MIDDLE / 2, 0.5 + MIDDLE / 2, len(space))
    return dict(zip(space.names, (low + share * (space.high - low)).tolist(), strict=True))


def recorded(
    task: Task,
    quality: str,
    transitions: int,
    folder: Path,
    *,
    data_is: str = "clean",
    log: int = 0,
    threads: int | None = None,
) -> Dataset:
    """A log of the benchmark, recorded once and kept in a folder, then disturbed."""
    kind, friction = KINDS[data_is], KINDS[data_is].disturbance.friction
    words = [task.name, quality, transitions]
    words += [kind.physics] if kind.physics != task.physics else []
    words += [f"friction-{friction:g}"] if friction != 1.0 else []
    words += [f"log-{log}"] if log else []
    path = folder / ("-".join(map(str, words)) + ".npz")
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{path}.lock"):
        if not path.exists():
            target = tasks.make(task.name, kind.physics)
            target = target if friction == 1.0 else target.with_friction(friction)
            truth = planted_truth(task, quality, log) if log else None
            simulator, key = CpuSimulator(target, threads=threads), jax.random.key(log)
            save(record_quality(simulator, quality, transitions=transitions, key=key, truth=truth), path)
    return disturb(load(path, task), kind.disturbance, task, jax.random.key(1 + 1000 * log))


if __name__ == "__main__":
    main()
