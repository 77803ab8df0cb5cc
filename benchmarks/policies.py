"""Return in the target of learnt policies: any learner, anywhere it can learn. One JSON file a run.

    python benchmarks/policies.py --robots hopper halfcheetah --at calibrated truth midrange --seeds 0 1 2
    python benchmarks/policies.py --methods bc cql morec --budget 20000
    python benchmarks/policies.py --methods fast-sac --budget 300s
    python benchmarks/policies.py --methods h2o --at midrange --set updates_per_step=0.25

Takes the calibrated parameters, and the spread of `distribution`, from `results/calibration`, and the logged data that
`calibration.py` records. Runs already there are skipped, so a row that is missing was not run. The budget is control
steps, or updates of a learner that does not simulate.
"""

import argparse
import json
from dataclasses import fields, replace
from itertools import product
from pathlib import Path

import jax
import numpy as np

from calibration import RESULTS as CALIBRATIONS
from calibration import budget, commit, recorded
from madoc import tasks
from madoc.calibration import CalibrationResult
from madoc.data.targets import paper_truth
from madoc.evaluation import evaluate
from madoc.pipeline.methods import make_method
from madoc.pipeline.orders import parse_settings
from madoc.policies import LEARNERS, NormalParameters, PolicyProblem, UniformParameters, learn_policy
from madoc.simulation.cpu import CpuSimulator
from madoc.types import entry_of

RESULTS = Path(__file__).parent / "results" / "policies"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", nargs="+", default=["hopper", "halfcheetah"])
    parser.add_argument("--methods", nargs="+", default=["sac"], choices=list(LEARNERS))
    parser.add_argument(
        "--at", nargs="+", default=["calibrated"], help="calibrated distribution uniform midrange truth"
    )
    parser.add_argument(
        "--calibrator", default="madoc-local-logged-300000", help="whose estimate, as results are named"
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--budget", type=budget, default=300_000, help="300000, or a time as 300s")
    parser.add_argument("--set", nargs="*", default=[], help="hyperparameters as name=value")
    parser.add_argument("--transitions", type=int, default=200_000)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--folder", type=Path, default=Path("runs/benchmark-data"), help="where recorded data is kept")
    arguments = parser.parse_args()
    revision = commit()
    RESULTS.mkdir(parents=True, exist_ok=True)
    for robot, name, seed in product(arguments.robots, arguments.methods, arguments.seeds):
        method = make_method(LEARNERS, name, parse_settings((tuple(arguments.set),)))
        entry = entry_of(method, LEARNERS)
        for at in arguments.at if entry.needs_parameters else ["-"]:
            where = f"{at}-{arguments.calibrator}" if at in ("calibrated", "distribution") else at
            words = [robot, name, *([where] if at != "-" else []), arguments.budget, *arguments.set, seed]
            path = RESULTS / ("-".join(map(str, words)).replace(" ", "") + ".json")
            if path.exists():
                continue
            row = {
                "robot": robot,
                "method": name,
                "at": at,
                "calibrator": arguments.calibrator if where != at else None,
                "seed": seed,
                "budget": arguments.budget,
                "unit": entry.unit,
                "set": arguments.set,
                "commit": revision,
            }
            row |= run(method, robot, at, arguments, seed)
            if row["status"] == "interrupted":
                return
            path.write_text(json.dumps(row, indent=1) + "\n")
            print(path.name, round(row["return"]), round(row["seconds"]), flush=True)


def run(method, robot: str, at: str, arguments: argparse.Namespace, seed: int) -> dict:
    """What the policy learnt there earns in the target, and what it cost."""
    simulator = CpuSimulator(tasks.make(robot, "legacy"), threads=arguments.threads)
    truth = simulator.parameters.vector(paper_truth(robot))
    dataset = None
    if entry_of(method, LEARNERS).needs_data:
        dataset = recorded(simulator.task, "medium", arguments.transitions, arguments.folder)
        dataset = replace(dataset, true_parameters=None)
    name = f"{robot}-medium-{arguments.calibrator}-{seed}.json"
    places = {
        "calibrated": lambda: _calibration(name).mean,
        "distribution": lambda: _distribution(simulator, _calibration(name)),
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


def _calibration(name: str) -> CalibrationResult:
    row, known = json.loads((CALIBRATIONS / name).read_text()), {field.name for field in fields(CalibrationResult)}
    return CalibrationResult.from_json({name: value for name, value in row.items() if name in known})


def _distribution(simulator: CpuSimulator, result: CalibrationResult) -> NormalParameters:
    joint = np.diag(result.std**2) if result.covariance is None else np.asarray(result.covariance)
    return NormalParameters(simulator.parameters, result.mean, joint)


if __name__ == "__main__":
    main()
