"""Pick rungs of a trained ladder and ship them: float16, a few hundred kilobytes a robot.

    python benchmarks/select_behaviours.py hopper --ladder runs/behaviours/hopper

`medium` is the rung nearest to 40 % of D4RL's expert return (sampled; D4RL's own stand at 42 to 44 % for HalfCheetah
and Hopper), `medium-replay` six rungs from the first
one up to it. Expert is the best rung of the ladder; NeoRL's three are the rungs nearest to 25, 50 and 75 % of it.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from madoc import tasks
from madoc.policies import behaviours

REPLAY_RUNGS = 6
MEDIUM_SHARE = 0.4


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("robot")
    parser.add_argument("--ladder", type=Path, required=True)
    arguments = parser.parse_args()

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
