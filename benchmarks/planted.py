"""Planted truths in robots of one's own: what `madoc calibrate` finds, how sure it is, and its verdict.

    python benchmarks/planted.py                                    # 3 robots in 5 situations
    python benchmarks/planted.py --coverage 100                     # how often 95 % intervals cover, on the pendulum

Robots and logs are those of `examples/`: spec files, and CSV files a run. Rows already there are skipped. Noise is a
share of each signal's spread; a situation's specs differ from the robot's own by what the situation is about.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path

import gymnasium
import numpy as np
from kept import RESULTS, Study, commit, commits
from ruamel.yaml import YAML

from madoc import robots
from madoc.pipeline import CalibrationOrder, Search, Source, calibrate_in
from madoc.robots.document import yaml_text

STUDY = Study(RESULTS / "planted.jsonl", ("robot", "situation", "seed"))
COVERAGE = Study(RESULTS / "planted-coverage.jsonl", ("robot", "problem"))
EXAMPLES = Path(__file__).parents[1] / "examples"
HOPPER = {
    "madoc": 1,
    "name": "user_hopper",
    "model": str(Path(gymnasium.__file__).parent / "envs/mujoco/assets/hopper.xml"),
    "control_step": 0.008,
    "signals": [
        {"name": f"{joint}_{kind}", "reads": f"{kind}({joint})"}
        for kind in ("position", "velocity")
        for joint in ("rootx", "rootz", "rooty", "thigh_joint", "leg_joint", "foot_joint")
    ],
    "actions": [
        {"name": f"{joint}_motor", "actuator": f"{joint}_joint", "low": -1, "high": 1}
        for joint in ("thigh", "leg", "foot")
    ],
    "parameters": [
        {"field": "body_mass", "element": "torso", "low": 2.0, "high": 5.0},
        {"field": "body_mass", "element": "thigh", "low": 2.0, "high": 6.0},
        {"field": "body_mass", "element": "leg", "low": 1.0, "high": 4.0},
        {"field": "body_mass", "element": "foot", "low": 3.0, "high": 7.0},
        {"field": "dof_damping", "element": "thigh_joint", "low": 0.2, "high": 3.0},
        {"field": "dof_damping", "element": "leg_joint", "low": 0.2, "high": 3.0},
        {"field": "dof_damping", "element": "foot_joint", "low": 0.2, "high": 3.0},
    ],
}
"""Gymnasium's Hopper as a user's MJCF: no fall, no reward, no range of the paper's."""
TRUTHS = {
    "pendulum": {"length": 0.42, "damping": 0.12, "friction": 0.3, "gain": 0.85},
    "arm": json.loads((EXAMPLES / "arm" / "truth.json").read_text()),
    "hopper": {
        "body_mass.torso": 4.2,
        "body_mass.thigh": 3.1,
        "body_mass.leg": 3.2,
        "body_mass.foot": 4.4,
        "dof_damping.thigh_joint": 1.7,
        "dof_damping.leg_joint": 0.7,
        "dof_damping.foot_joint": 1.3,
    },
}
SITUATIONS = ("exact", "noise", "hidden-velocity", "delay", "wrong-fixed")
EXPECTED = {"wrong-fixed": "MODEL_MISMATCH"}
"""CALIBRATED where nothing else is right."""
NOISE = 0.005
WRONG = 0
"""Which parameter stands fixed at the model's own value, which is not the machine's."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", nargs="+", default=list(TRUTHS), choices=list(TRUTHS))
    parser.add_argument("--situations", nargs="+", default=list(SITUATIONS), choices=SITUATIONS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--coverage", type=int, default=0, help="problems on the pendulum; the table is then left out")
    parser.add_argument(
        "--budget", default=None, help="of a calibration, such as 300000 or 60s; as `madoc calibrate` by default"
    )
    arguments = parser.parse_args()
    if arguments.coverage:
        cover(arguments.coverage, arguments.budget)
        return
    for robot in arguments.robots:
        for situation in arguments.situations:
            for seed in arguments.seeds:
                asked = {"robot": robot, "situation": situation, "seed": seed}
                with STUDY.claimed(asked) as ours, tempfile.TemporaryDirectory() as folder:
                    if ours:
                        row = planted(Path(folder), robot, situation, seed, arguments.budget)
                        STUDY.add(row)
                        print(*asked.values(), row["verdict"]["word"], f"{row['seconds']:.0f} s", flush=True)


def planted(folder: Path, robot: str, situation: str, seed: int, budget: str | None) -> dict:
    """Record the pretended machine, calibrate as a user would, compare with what was planted."""
    machine, truth = base(robot), dict(TRUTHS[robot])
    known = deepcopy(machine)
    if situation == "hidden-velocity":
        known["signals"] = [signal for signal in machine["signals"] if signal["reads"].startswith("position")]
    if situation == "delay":
        delay = {"field": "action_delay", "low": 0.0, "high": 2.5 * machine["control_step"]}
        machine["parameters"].append(delay)
        known["parameters"].append(dict(delay))
        truth["action_delay"] = machine["control_step"]
    if situation == "wrong-fixed":
        del known["parameters"][WRONG]
    logs = record(folder, machine, truth, noise=NOISE if situation == "noise" else 0.0, seed=seed)
    spec = write(folder / "known.yaml", known)
    order = CalibrationOrder(str(spec), Source((str(logs),)), Search(method="auto", budget=budget, seed=seed))
    start = time.monotonic()
    result = calibrate_in(folder / "run", order).to_json()
    return {
        "robot": robot,
        "situation": situation,
        "expected": EXPECTED.get(situation, "CALIBRATED"),
        "verdict": result["verdict"],
        "method": result["method"],
        "parameters": compared(result, truth),
        "warnings": result["warnings"],
        "control_steps": result["control_steps"],
        "seconds": time.monotonic() - start,
        "seed": seed,
        "commit": commit(),
    }


def cover(problems: int, budget: str | None) -> None:
    """How often 95 % intervals of least squares cover the truth: a new truth, new commands and new noise each time."""
    machine = base("pendulum")
    for problem in range(problems):
        asked = {"robot": "pendulum", "problem": problem, "noise": NOISE}
        with COVERAGE.claimed(asked) as ours, tempfile.TemporaryDirectory() as name:
            if not ours:
                continue
            folder, random = Path(name), np.random.default_rng(problem)
            space = robots.load(write(folder / "known.yaml", machine)).task.parameters
            drawn = space.low + random.uniform(0.15, 0.85, len(space)) * (space.high - space.low)
            truth = dict(zip(space.names, drawn.tolist(), strict=True))
            logs = record(folder, machine, truth, noise=NOISE, seed=problem)
            search = Search(method="least-squares", budget=budget, seed=problem)
            order = CalibrationOrder(str(folder / "known.yaml"), Source((str(logs),)), search)
            result = calibrate_in(folder / "run", order).to_json()
            COVERAGE.add(asked | {"status": result["status"], "parameters": compared(result, truth)})
    print(covered(COVERAGE.rows()))


def covered(rows: Sequence[dict]) -> str:
    """How many intervals hold the truth, in a sentence."""
    held = [part["covered"] for row in rows for part in row["parameters"].values()]
    return (
        f"Of {len(rows)} problems planted on the pendulum (least squares, noise of {NOISE:g} of each signal's spread), "
        f"{100 * np.mean(held):.1f} % of 95 % intervals cover the truth ({commits(rows)})."
    )


def compared(result: dict, truth: dict[str, float]) -> dict[str, dict]:
    """Each parameter beside its truth."""
    rows = {}
    for name, row in result["parameters"].items():
        interval = row.get("interval")
        rows[name] = {
            "truth": truth[name],
            "estimate": row["estimate"],
            "interval": interval,
            "covered": interval is not None and interval[0] <= truth[name] <= interval[1],
            "percent_of_range": 100 * abs(row["estimate"] - truth[name]) / (row["high"] - row["low"]),
            "unit": row["unit"],
        }
    return rows


def base(robot: str) -> dict:
    """The robot's spec, its model named by its whole path."""
    if robot == "hopper":
        return deepcopy(HOPPER)
    spec = YAML(typ="safe").load(EXAMPLES / robot / f"{robot}.yaml")
    spec.pop("log", None)
    return spec | {"model": str(EXAMPLES / robot / spec["model"])}


def write(path: Path, spec: dict) -> Path:
    """A spec file."""
    path.write_text(yaml_text(spec))
    return path


def record(folder: Path, machine: dict, truth: dict[str, float], *, noise: float, seed: int) -> Path:
    """Logs of the pretended machine, as `examples/record_logs.py` leaves them."""
    spec, logs = write(folder / "machine.yaml", machine), folder / "logs"
    (folder / "truth.json").write_text(json.dumps(truth))
    words = [spec, folder / "truth.json", logs, "--noise", noise, "--seed", seed]
    command = [sys.executable, EXAMPLES / "record_logs.py", *words]
    subprocess.run([str(word) for word in command], check=True, stdout=subprocess.DEVNULL)
    return logs


if __name__ == "__main__":
    main()
