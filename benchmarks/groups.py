"""Groups against one agent where the reward is as clean as ours, and where it is the paper's: one JSON file a run.

    python benchmarks/groups.py --robots halfcheetah --rewards ours paper --seeds 0 1 2

Everything else is the default. `paper` takes from the reward what Madoc adds to it: the blur, the moving average of
the discriminators, the weights of overlap, the wide bound of f_sa, and the paper's ten draws an epoch stand for ours.
"""

import argparse
import json
from dataclasses import replace
from itertools import product
from pathlib import Path

from calibration import commit, recorded, run
from madoc import tasks
from madoc.calibration import CALIBRATORS, CalibrationProblem
from madoc.simulation.cpu import CpuSimulator

RESULTS = Path(__file__).parent / "results" / "groups"
PAPER = {"reward_size": 0.0, "judge_rate": 1.0, "weigh_overlap": False, "pair_bound": 2.0}
FEW_DRAWS = {"draws": 10, "horizon": 100}
REWARDS = {
    "ours": ({}, {}),
    "no blur": ({}, {"reward_size": 0.0}),
    "no average": ({}, {"judge_rate": 1.0}),
    "ten draws": (FEW_DRAWS, {}),
    "paper": (FEW_DRAWS, PAPER),
}
"""Changes of Madoc and of its agents."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", nargs="+", default=["halfcheetah"])
    parser.add_argument("--rewards", nargs="+", default=list(REWARDS), choices=list(REWARDS))
    parser.add_argument("--methods", nargs="+", default=["madoc", "madoc-s"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--budget", type=int, default=300_000)
    parser.add_argument("--transitions", type=int, default=200_000)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--folder", type=Path, default=Path("runs/benchmark-data"), help="where recorded data is kept")
    arguments = parser.parse_args()
    RESULTS.mkdir(parents=True, exist_ok=True)
    revision = commit()
    for robot in arguments.robots:
        task = tasks.make(robot, "legacy")
        dataset = recorded(task, "medium", arguments.transitions, arguments.folder)
        problem = CalibrationProblem(dataset, CpuSimulator(task, threads=arguments.threads))
        for reward, seed, method in product(arguments.rewards, arguments.seeds, arguments.methods):
            path = RESULTS / f"{robot}-{reward.replace(' ', '-')}-{method}-{arguments.budget}-{seed}.json"
            if path.exists():
                continue
            changes, of_agents = REWARDS[reward]
            agents = replace(CALIBRATORS[method].make().agents, **of_agents)
            settings = {"starts": "policy", "agents": agents} | changes
            row = {"robot": robot, "reward": reward, "budget": arguments.budget, "seed": seed, "commit": revision}
            row |= run(method, settings, problem, dataset, seed, arguments.budget)
            if row["status"] == "interrupted":
                return
            path.write_text(json.dumps(row, indent=1) + "\n")
            print(path.name, row["error"]["mean_absolute"], f"{row['wall_seconds']:.0f} s", flush=True)


if __name__ == "__main__":
    main()
