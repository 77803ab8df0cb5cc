"""The behaviour policies that `madoc record` replays: SAC in the legacy target at the paper's truth, and its stages.

    python benchmarks/behaviours.py train hopper --steps 1000000 --out runs/behaviours
    python benchmarks/behaviours.py select hopper --ladder runs/behaviours/hopper

`train` keeps the policy and its return in the target every 20 000 control steps. Lean networks (2 x 128) and one
update per four control steps: a ladder of policies is wanted, not a record. `select` picks rungs of it and ships them:
float16, a few hundred kilobytes a robot. `medium` is the rung nearest to 40 % of D4RL's expert return (sampled; D4RL's
own stand at 42 to 44 % for HalfCheetah and Hopper), `medium-replay` six rungs from the first one up to it. Expert is
the best rung of the ladder; NeoRL's three are the rungs nearest to 25, 50 and 75 % of it.
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
from madoc.policies import behaviours
from madoc.policies.base import PolicyProblem
from madoc.policies.sac import SAC
from madoc.simulation.cpu import CpuSimulator

REPLAY_RUNGS = 6
MEDIUM_SHARE = 0.4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    training = commands.add_parser("train")
    training.add_argument("robot", choices=sorted(tasks.TASKS))
    training.add_argument("--steps", type=int, default=1_000_000)
    training.add_argument("--seed", type=int, default=0)
    training.add_argument("--updates-per-step", type=float, default=0.25)
    training.add_argument("--every", type=int, default=20_000)
    training.add_argument("--out", type=Path, default=Path("runs/behaviours"))
    training.set_defaults(run=train)
    selecting = commands.add_parser("select")
    selecting.add_argument("robot", choices=sorted(tasks.TASKS))
    selecting.add_argument("--ladder", type=Path, required=True)
    selecting.set_defaults(run=select)
    arguments = parser.parse_args()
    arguments.run(arguments)


def train(arguments: argparse.Namespace) -> None:
    """Train the ladder of a robot."""
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


def select(arguments: argparse.Namespace) -> None:
    """Ship the rungs of a robot's ladder."""
    rows = [json.loads(line) for line in (arguments.ladder / "ladder.jsonl").read_text().splitlines()]
    returns = np.array([row["sampled"]["return"] for row in rows])
    expert = int(returns.argmax())
    climb = returns[: expert + 1]
    medium = int(np.abs(climb - MEDIUM_SHARE * tasks.make(arguments.robot).reference_returns[1]).argmin())
    replay = sorted(set(np.linspace(0, medium, REPLAY_RUNGS).round().astype(int).tolist()))
    nearest = {share: int(np.abs(climb - share * returns[expert]).argmin()) for share in (0.25, 0.5, 0.75)}
    chosen = {
        "medium": [medium],
        "medium-replay": replay,
        "medium-expert": [medium, expert],
        "neorl-low": [nearest[0.25]],
        "neorl-medium": [nearest[0.5]],
        "neorl-high": [nearest[0.75]],
    }
    kept = sorted({index for indices in chosen.values() for index in indices})
    place = {index: position for position, index in enumerate(kept)}
    policies = [_layers(arguments.ladder / f"{rows[index]['snapshot']:04d}.npz") for index in kept]
    arrays = {
        f"{kind}_{layer}": np.stack([policy[layer][kind] for policy in policies]).astype(np.float16)
        for layer in range(len(policies[0]))
        for kind in ("weight", "bias")
    }
    about = {
        "layers": len(policies[0]),
        "control_steps": [rows[index]["control_steps"] for index in kept],
        "returns": [round(float(returns[index]), 1) for index in kept],
        "qualities": {name: [place[index] for index in indices] for name, indices in chosen.items()},
    }
    target = Path(behaviours.__file__).parent / f"{arguments.robot}.npz"
    np.savez_compressed(target, about=np.array(json.dumps(about)), **arrays)
    print(f"{target.name}: {target.stat().st_size / 1e6:.2f} MB")
    for name, indices in about["qualities"].items():
        print(name, [about["returns"][index] for index in indices])


def _layers(path: Path) -> list[dict[str, np.ndarray]]:
    """Weights (inputs, outputs) and biases of a snapshot: leaves in the order weight, bias, ..., offset, scale."""
    with np.load(path) as file:
        leaves = [file[name] for name in file.files][:-2]
    return [{"weight": weight.T, "bias": bias} for weight, bias in zip(leaves[::2], leaves[1::2], strict=True)]


if __name__ == "__main__":
    main()
