"""Train the behaviour policies that `madoc record` replays: SAC in the legacy target at the paper's truth.

    python benchmarks/train_behaviours.py hopper --steps 1000000 --out runs/behaviours

Every 20 000 control steps the policy and its return in the target are kept; `select_behaviours.py` picks from them.
Lean networks (2 x 128) and one update per four control steps: a ladder of policies is wanted, not a record.
"""

import argparse
import json
import time
from pathlib import Path

import equinox as eqx
import jax
import numpy as np

from madoc import tasks
from madoc.data.targets import paper_truth
from madoc.evaluation import evaluate
from madoc.policies.base import PolicyProblem
from madoc.policies.sac import SAC
from madoc.simulation.cpu import CpuSimulator


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("robot", choices=sorted(tasks.TASKS))
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--updates-per-step", type=float, default=0.25)
    parser.add_argument("--every", type=int, default=20_000)
    parser.add_argument("--out", type=Path, default=Path("runs/behaviours"))
    arguments = parser.parse_args()

    simulator = CpuSimulator(tasks.make(arguments.robot, "legacy"), threads=1)
    truth = simulator.parameters.vector(paper_truth(arguments.robot))
    problem = PolicyProblem(simulator, truth)
    learner = SAC(hidden=(128, 128), updates_per_step=arguments.updates_per_step)
    folder = arguments.out / arguments.robot
    folder.mkdir(parents=True, exist_ok=True)
    state = learner.init(problem, jax.random.key(arguments.seed))
    started, kept, acted = time.monotonic(), 0, 0
    with (folder / "ladder.jsonl").open("w") as ladder:
        while acted < arguments.steps:
            state, epoch = learner.step(problem, state)
            acted += epoch.control_steps
            if acted < (kept + 1) * arguments.every:
                continue
            kept += 1
            policy = learner.policy(state)
            returns = evaluate(policy, simulator, truth, key=jax.random.key(kept), episodes=10)
            sampled = evaluate(policy, simulator, truth, key=jax.random.key(kept), episodes=10, deterministic=False)
            leaves = jax.tree.leaves(eqx.filter(policy, eqx.is_array))
            np.savez(folder / f"{kept:04d}.npz", *[np.asarray(leaf) for leaf in leaves])
            row = {
                "snapshot": kept,
                "control_steps": acted,
                "seconds": round(time.monotonic() - started),
                "deterministic": returns.summary(),
                "sampled": sampled.summary(),
            }
            print(json.dumps(row), file=ladder, flush=True)


if __name__ == "__main__":
    main()
