"""Where groups pay: Madoc by the number of parameters, draws an epoch, and who its agents are. One JSON file a run.

    python benchmarks/groups.py --parameters 4 12 32 --draws 10 30 100 --groups one physics random each --seeds 0 1 2

An Ant of our own truths, after figure 3b of Jiang et al. 2024: gravity, the torso's mass, and of each leg two masses,
dampings, armatures and friction losses, in an order that is drawn once, of which a run calibrates the first. What it
does not calibrate has the same value in target and simulator. Each seed plants another truth, in the middle 80 % of
every range, and records `medium` behaviour there. `random` has groups of the sizes of those by physics, of parameters
drawn at random; of up to 4 parameters both make one group. `each-dop` is `each` with the credit of Eq. (12) throughout.
Errors are in % of the ranges: parameters have different units, and exact logs tell all of them to within rounding. Runs
already there are skipped.
"""

import argparse
import json
import time
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import jax
import numpy as np

from calibration import commit
from madoc import tasks
from madoc.calibration import CalibrationProblem, calibrate
from madoc.calibration.madoc.calibrator import Madoc
from madoc.calibration.madoc.grouping import by_first_appearance
from madoc.calibration.madoc.state import MadocState
from madoc.data import Dataset
from madoc.data.record import record
from madoc.parameters import Parameter, ParameterSpace
from madoc.policies.behaviours import ladder, policy_of
from madoc.simulation.cpu import CpuSimulator
from madoc.tasks import Task
from madoc.types import Epoch

RESULTS = Path(__file__).parent / "results" / "groups"
GROUPS = ("one", "physics", "random", "learned", "each", "each-dop")
WHOLE = (Parameter("gravity", "", -15.0, -5.0), Parameter("body_mass", "torso", 0.1, 0.55))
OF_A_LEG = {
    "body_mass": {"aux": (0.01, 0.06), "ankle": (0.02, 0.11)},
    "dof_damping": {"hip": (0.0, 2.0), "ankle": (0.0, 2.0)},
    "dof_armature": {"hip": (0.3, 1.7), "ankle": (0.3, 1.7)},
    "dof_frictionloss": {"hip": (0.0, 20.0), "ankle": (0.0, 20.0)},
}
"""Ranges by field and part of a leg; a motor's largest torque is 150 N·m."""
STEPS = 1000
"""Control steps of an epoch, shared by its draws."""


@dataclass(frozen=True)
class AtRandom(Madoc):
    """Madoc with groups of as many parameters as those by physics, drawn at random."""

    def step(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Epoch]:
        """One epoch; where it finds the groups, their parameters change places."""
        following, epoch = super().step(problem, state)
        if state.grouped < following.grouped == self.grouping_epochs:
            seed = int(jax.random.randint(following.key, (), 0, 2**31 - 1))
            labels = by_first_appearance(np.random.default_rng(seed).permutation(following.labels))
            following = replace(following, labels=labels)
        return following, epoch


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--parameters", nargs="+", type=int, default=[4, 12, 32])
    parser.add_argument("--draws", nargs="+", type=int, default=[10, 30, 100])
    parser.add_argument("--groups", nargs="+", default=["one", "physics", "random", "each"], choices=GROUPS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--budget", type=int, default=300_000)
    parser.add_argument("--transitions", type=int, default=50_000)
    parser.add_argument("--threads", type=int, default=None)
    arguments = parser.parse_args()
    RESULTS.mkdir(parents=True, exist_ok=True)
    revision = commit()
    for seed, count in product(arguments.seeds, arguments.parameters):
        task = ant_of(count)
        simulator = CpuSimulator(task, threads=arguments.threads)
        dataset = planted(simulator, seed, arguments.transitions)
        problem = CalibrationProblem(dataset, simulator)
        for draws, groups in product(arguments.draws, arguments.groups):
            path = RESULTS / f"{count}-{draws}-{groups}-{seed}.json"
            if path.exists():
                continue
            row = {"parameters": count, "draws": draws, "groups": groups, "seed": seed, "budget": arguments.budget}
            row |= {"commit": revision} | run(agents(groups, draws), problem, dataset, seed, arguments.budget)
            if row["status"] == "interrupted":
                return
            path.write_text(json.dumps(row, indent=1) + "\n")
            print(path.name, f"{row['error']:.2f} % of range", f"{row['seconds']:.0f} s", flush=True)


def ant_of(count: int) -> Task:
    """The Ant with the first `count` parameters of the study."""
    of_legs = tuple(
        Parameter(field, f"{part}_{leg}", *span)
        for field, parts in OF_A_LEG.items()
        for part, span in parts.items()
        for leg in (1, 2, 3, 4)
    )
    every = WHOLE + of_legs
    order = np.random.default_rng(0).permutation(len(every))[:count]
    if count > len(order):
        raise SystemExit(f"--parameters: expected at most {len(every)}, got {count}")
    return replace(tasks.make("ant", "legacy"), parameters=ParameterSpace(tuple(every[index] for index in order)))


def planted(simulator: CpuSimulator, seed: int, transitions: int) -> Dataset:
    """A log of `medium` behaviour where every parameter is planted in the middle 80 % of its range."""
    space = simulator.parameters
    values = space.to_physical(np.random.default_rng(seed).uniform(-0.8, 0.8, len(space)))
    rungs = ladder("ant")
    return record(
        policy_of(rungs.saved[rungs.qualities["medium"][-1]]),
        simulator,
        dict(zip(space.names, values.tolist(), strict=True)),
        transitions=transitions,
        key=jax.random.key(seed),
        origin=f"planted Ant {seed}",
    )


def agents(groups: str, draws: int) -> Madoc:
    """Madoc, freely running, with `draws` an epoch and these groups."""
    settings = {"draws": draws, "horizon": -(-STEPS // draws), "epoch_steps": STEPS}
    if groups == "random":
        return AtRandom(groups="physics", **settings)
    name, _, mixing = groups.partition("-")
    return Madoc(groups=name, mixing=mixing or Madoc.mixing, **settings)


def run(method: Madoc, problem: CalibrationProblem, dataset: Dataset, seed: int, budget: int) -> dict:
    """What one calibration found; errors in % of the range."""
    started, space = time.monotonic(), problem.simulator.parameters
    result = calibrate(method, problem, key=jax.random.key(seed), budget=budget, truth=dataset.true_parameters)
    found = result.to_json()
    width = dict(zip(space.names, space.high - space.low, strict=True))
    errors = {name: round(100.0 * error / width[name], 3) for name, error in found["error"]["per_parameter"].items()}
    return {
        "status": found["status"],
        "error": found["error"]["mean_percent_of_range"],
        "worst": max(errors.values()),
        "errors": errors,
        "labels": found["groups"],
        "control_steps": found["control_steps"],
        "seconds": round(time.monotonic() - started, 1),
    }


if __name__ == "__main__":
    main()
