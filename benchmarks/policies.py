"""Return in the target of learnt policies: any learner, anywhere it can learn; a row of results/policies.jsonl each.

    python benchmarks/policies.py --robots hopper halfcheetah --at calibrated truth midrange --seeds 0 1 2
    python benchmarks/policies.py --methods bc cql morec --budget 20000
    python benchmarks/policies.py --methods fast-sac --budget 300s
    python benchmarks/policies.py --methods h2o --at midrange --set updates_per_step=0.25

Takes the calibrated parameters, and the spread of `distribution`, from what `calibration.py` has found on log 0 of the
robot's clean medium data, and records that log if it learns from data. Rows already there are skipped. The budget is
control steps, or updates of a learner that does not simulate.
"""

import argparse
from dataclasses import fields, replace
from itertools import product
from pathlib import Path

import jax
import numpy as np
from kept import CALIBRATIONS, POLICIES, commit

from calibration import budget, recorded
from madoc import tasks
from madoc.calibration import CalibrationResult
from madoc.data.targets import paper_truth
from madoc.evaluation import evaluate
from madoc.pipeline.methods import make_method
from madoc.pipeline.orders import parse_settings
from madoc.policies import LEARNERS, NormalParameters, PolicyProblem, UniformParameters, learn_policy
from madoc.simulation.cpu import CpuSimulator
from madoc.types import entry_of


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", nargs="+", default=["hopper", "halfcheetah"])
    parser.add_argument("--methods", nargs="+", default=["sac"], choices=list(LEARNERS))
    parser.add_argument(
        "--at", nargs="+", default=["calibrated"], help="calibrated distribution uniform midrange truth"
    )
    parser.add_argument("--calibrator", default="madoc", help="whose estimate")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--budget", type=budget, default=300_000, help="300000, or a time as 300s")
    parser.add_argument("--set", nargs="*", default=[], help="hyperparameters as name=value")
    parser.add_argument("--transitions", type=int, default=200_000)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--anew", action="store_true", help="learn again what has a row of another commit")
    parser.add_argument("--folder", type=Path, default=Path("runs/benchmark-data"), help="where recorded data is kept")
    arguments = parser.parse_args()
    revision = commit()
    for robot, name, seed in product(arguments.robots, arguments.methods, arguments.seeds):
        method = make_method(LEARNERS, name, parse_settings((tuple(arguments.set),)))
        entry = entry_of(method, LEARNERS)
        for at in arguments.at if entry.needs_parameters else ["-"]:
            asked = {
                "robot": robot,
                "method": name,
                "at": at,
                "calibrator": arguments.calibrator if at in ("calibrated", "distribution") else None,
                "seed": seed,
                "budget": arguments.budget,
                "unit": entry.unit,
                "set": arguments.set,
                "commit": revision,
            }
            with POLICIES.claimed(asked, revision if arguments.anew else None) as ours:
                if not ours:
                    continue
                row = run(method, robot, at, arguments, seed)
                if row["status"] == "interrupted":
                    return
                POLICIES.add(asked | row)
            print(robot, name, at, seed, round(row["return"]), f"{row['seconds']:.0f} s", flush=True)


def run(method, robot: str, at: str, arguments: argparse.Namespace, seed: int) -> dict:
    """What the policy learnt there earns in the target, and what it cost."""
    simulator = CpuSimulator(tasks.make(robot, "legacy"), threads=arguments.threads)
    truth = simulator.parameters.vector(paper_truth(robot))
    dataset = None
    if entry_of(method, LEARNERS).needs_data:
        dataset = recorded(simulator.task, "medium", arguments.transitions, arguments.folder)
        dataset = replace(dataset, true_parameters=None)
    places = {
        "calibrated": lambda: _calibration(robot, arguments.calibrator).mean,
        "distribution": lambda: _distribution(simulator, _calibration(robot, arguments.calibrator)),
        "uniform": lambda: UniformParameters(simulator.parameters),
        "midrange": lambda: simulator.parameters.middle,
        "truth": lambda: truth,
        "-": lambda: simulator.parameters.middle,
    }
    problem = PolicyProblem(simulator, places[at](), dataset)
    learnt = learn_policy(method, problem, key=jax.random.key(seed), budget=arguments.budget)
    judged = {"key": jax.random.key(1000 + seed), "episodes": arguments.episodes}
    return evaluate(learnt.policy, simulator, truth, **judged).summary() | {
        "seconds": learnt.seconds,
        "control_steps": learnt.control_steps,
        "updates": learnt.updates,
        "status": learnt.status,
        "spent": learnt.spent,
    }


def _calibration(robot: str, method: str) -> CalibrationResult:
    """The estimate of a method after the most control steps."""
    asked = {"robot": robot, "quality": "medium", "data": "clean", "log": 0, "method": method}
    found = [row for row in CALIBRATIONS.rows() if "error" in row and all(row[name] == asked[name] for name in asked)]
    if not found:
        raise SystemExit(
            f"no calibration of {robot}-medium by {method} was kept; run it with benchmarks/calibration.py"
        )
    row, known = max(found, key=lambda row: row["control_steps"]), {field.name for field in fields(CalibrationResult)}
    return CalibrationResult.from_json({name: value for name, value in row.items() if name in known})


def _distribution(simulator: CpuSimulator, result: CalibrationResult) -> NormalParameters:
    joint = np.diag(result.std**2) if result.covariance is None else np.asarray(result.covariance)
    return NormalParameters(simulator.parameters, result.mean, joint)


if __name__ == "__main__":
    main()
