"""Return in the target of a policy learnt at the calibrated parameters, at the truth, and at mid-range.

    python benchmarks/policies.py --robots hopper halfcheetah --seeds 0 1 2

Takes the calibrated parameters from `results/calibration` (run `calibration.py` first). One JSON file a run; those
already there are skipped, so a row that is missing was not run.
"""

import argparse
import json
from dataclasses import fields
from pathlib import Path

import jax

from calibration import RESULTS as CALIBRATIONS
from calibration import commit
from madoc import tasks
from madoc.calibration import CalibrationResult
from madoc.data.targets import paper_truth
from madoc.evaluation import evaluate
from madoc.policies import SAC, PolicyProblem, learn_policy
from madoc.simulation.cpu import CpuSimulator

RESULTS = Path(__file__).parent / "results" / "policies"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", nargs="+", default=["hopper", "halfcheetah"])
    parser.add_argument("--at", nargs="+", default=["calibrated", "truth", "midrange"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--budget", type=int, default=300_000)
    parser.add_argument("--hidden", type=int, default=256)
    parser.add_argument("--updates-per-step", type=float, default=1.0)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--threads", type=int, default=None)
    arguments = parser.parse_args()
    RESULTS.mkdir(parents=True, exist_ok=True)
    for seed in arguments.seeds:
        for robot in arguments.robots:
            simulator = CpuSimulator(tasks.make(robot, "legacy"), threads=arguments.threads)
            truth = simulator.parameters.vector(paper_truth(robot))
            calibrated = CALIBRATIONS / f"{robot}-medium-madoc-logged-300000-{seed}.json"
            parameters = {
                "calibrated": lambda path=calibrated: _estimate(path),
                "truth": lambda truth=truth: truth,
                "midrange": lambda simulator=simulator: simulator.parameters.middle,
            }
            for at in arguments.at:
                path = RESULTS / f"{robot}-{at}-{arguments.budget}-{seed}.json"
                if path.exists():
                    continue
                learner = SAC(hidden=(arguments.hidden,) * 2, updates_per_step=arguments.updates_per_step)
                problem = PolicyProblem(simulator, parameters[at]())
                learnt = learn_policy(learner, problem, key=jax.random.key(seed), budget=arguments.budget)
                returns = evaluate(
                    learnt.policy, simulator, truth, key=jax.random.key(1000 + seed), episodes=arguments.episodes
                )
                row = returns.summary() | {
                    "robot": robot,
                    "at": at,
                    "seed": seed,
                    "budget": arguments.budget,
                    "hidden": arguments.hidden,
                    "updates_per_step": arguments.updates_per_step,
                    "seconds": learnt.seconds,
                    "commit": commit(),
                }
                path.write_text(json.dumps(row, indent=1) + "\n")
                print(path.name, round(row["return"]), round(learnt.seconds), flush=True)


def _estimate(path: Path):
    row, known = json.loads(path.read_text()), {field.name for field in fields(CalibrationResult)}
    return CalibrationResult.from_json({name: value for name, value in row.items() if name in known}).mean


if __name__ == "__main__":
    main()
