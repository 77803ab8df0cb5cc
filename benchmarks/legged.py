"""A quadruped that logs its joint encoders and an IMU alone: what `madoc calibrate` makes of truths drawn anew.

    python benchmarks/legged.py --seeds 0 1 2
    python benchmarks/legged.py --table

A trunk of 5 kg or so on four legs of three position servos trots on the spot for 15 s, at 50 rows a second. What is
logged has the noise of such sensors: angles 0.5 mrad, their speeds 0.05 rad/s, attitude 2 mrad, turning 0.01 rad/s,
acceleration 0.1 m/s². Where the trunk is, and how fast it moves, is not logged. The tool runs with its defaults and a
budget of time, judging included.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import mujoco
import numpy as np
import yaml
from adversary import solved
from jaxtyping import Float
from kept import RESULTS, Study, commits

from madoc import robots, simulation

STUDY = Study(RESULTS / "legged.jsonl", ("seed", "budget"))
LEGS = {"FR": (0.188, -1), "FL": (0.188, 1), "RR": (-0.188, -1), "RL": (-0.188, 1)}
"""Place of each hip along the trunk, m, and its side."""
JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "thigh", "calf"))
STEP, SECONDS = 0.02, 15.0
HOME, UPRIGHT = (0.0, 0.9, -1.8), 0.85
"""Angles of a leg that stands, and the least cosine of the trunk's tilt; a trot that falls is drawn again."""
NOISE = {"angle": 5e-4, "speed": 0.05, "attitude": 2e-3, "gyro": 0.01, "accelerometer": 0.1}
FREE: dict[str, tuple[str, tuple[str, ...], tuple[float, float], tuple[float, float]]] = {
    "kp": ("actuator_gain", JOINTS, (20.0, 100.0), (40.0, 80.0)),
    "kd": ("actuator_kv", JOINTS, (0.2, 4.0), (0.8, 2.5)),
    "trunk_mass": ("body_mass", ("trunk",), (3.0, 9.0), (4.0, 7.0)),
    "hip_friction": ("dof_frictionloss", JOINTS[0::3], (0.0, 1.0), (0.1, 0.6)),
    "thigh_friction": ("dof_frictionloss", JOINTS[1::3], (0.0, 1.0), (0.1, 0.6)),
    "calf_friction": ("dof_frictionloss", JOINTS[2::3], (0.0, 1.0), (0.1, 0.8)),
    "armature": ("dof_armature", JOINTS[0::3] + JOINTS[1::3], (0.0, 0.03), (0.003, 0.015)),
    "calf_armature": ("dof_armature", JOINTS[2::3], (0.0, 0.05), (0.006, 0.025)),
    "foot_friction": ("geom_friction", tuple(f"{leg}_foot" for leg in LEGS), (0.2, 1.2), (0.35, 0.8)),
}
"""Field, elements, range of the search, and range of the truth."""
LEG = """
<body name="{leg}_hip" pos="{x} {y} 0"><joint name="{leg}_hip" axis="1 0 0"/>
  <inertial pos="0 {hip} 0" mass="0.59" diaginertia="0.00041 0.00041 0.00056"/>
  <body pos="0 {out} 0"><joint name="{leg}_thigh" axis="0 1 0"/>
    <inertial pos="0 {thigh} -0.034" mass="0.92" diaginertia="0.0049 0.0046 0.0011"/>
    <body pos="0 0 -0.213"><joint name="{leg}_calf" axis="0 1 0"/>
      <inertial pos="0.003 0 -0.12" mass="0.22" diaginertia="0.0029 0.0029 0.00005"/>
      <geom name="{leg}_foot" type="sphere" size="0.023" pos="0 0 -0.213" friction="0.6" priority="1" mass="0"/>
</body></body></body>"""
MODEL = """<mujoco model="quadruped"><compiler angle="radian"/>
<option timestep="0.004" integrator="implicitfast"/>
<default><joint damping="0.2" armature="0.005" frictionloss="0.2"/>
<position kp="50" kv="1" forcerange="-35 35"/></default>
<worldbody><geom name="floor" type="plane" size="5 5 0.1"/>
<body name="trunk" pos="0 0 0.445"><freejoint name="base"/><site name="imu" pos="-0.01 0 0.02"/>
<inertial pos="0.02 0 0" mass="5.2" diaginertia="0.016 0.056 0.06"/>{legs}</body></worldbody>
<actuator>{drives}</actuator>
<sensor><framequat name="attitude" objtype="site" objname="imu"/><gyro name="gyro" site="imu"/>
<accelerometer name="accelerometer" site="imu"/></sensor></mujoco>"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--budget", default="300s")
    parser.add_argument("--results", type=Path, default=STUDY.file)
    parser.add_argument("--table", action="store_true", help="print the summary of what is there, and run nothing")
    arguments = parser.parse_args()
    study = replace(STUDY, file=arguments.results)
    for seed in arguments.seeds if not arguments.table else ():
        with study.claimed({"seed": seed, "budget": arguments.budget}) as ours:
            if ours:
                study.add(solve(seed, arguments.budget))
    print(table(study.rows()))


def solve(seed: int, budget: str) -> dict[str, Any]:
    """Calibrate to a log of one quadruped, and compare."""
    with tempfile.TemporaryDirectory() as temporary:
        spec, logs, truth = write(seed, Path(temporary))
        return {"seed": seed, "budget": budget} | solved(spec, logs, truth, "--budget", budget, limit=3600.0)


def write(seed: int, folder: Path) -> tuple[Path, Path, dict[str, float]]:
    """A model, a spec and a log whose truth is drawn."""
    random, spec = np.random.default_rng(seed), folder / "quadruped.yaml"
    legs = "".join(
        LEG.format(leg=leg, x=x, y=0.047 * side, hip=0.01 * side, out=0.08 * side, thigh=-0.02 * side)
        for leg, (x, side) in LEGS.items()
    )
    drives = "".join(f'<position name="{joint}" joint="{joint}"/>' for joint in JOINTS)
    (folder / "quadruped.xml").write_text(MODEL.format(legs=legs, drives=drives))
    spec.write_text(yaml.safe_dump(spec_of(), sort_keys=False))
    truth = {name: float(random.uniform(*drawn)) for name, (_, _, _, drawn) in FREE.items()}
    robot = robots.load(spec)
    observation, targets = walked(robot, truth, random)
    header = ",".join(["time", *robot.task.signals, *(f"{joint}_target" for joint in JOINTS)])
    logs = folder / "logs"
    logs.mkdir()
    rows = np.column_stack([STEP * np.arange(len(targets)), observation, targets])
    np.savetxt(logs / "run.csv", rows, "%.7g", ",", header=header, comments="")
    return spec, logs, truth


def spec_of() -> dict[str, Any]:
    """The spec as a user writes it."""
    parts = [("attitude", i, "wxyz"[i]) for i in range(4)]
    parts += [(sensor, i, "xyz"[i]) for sensor in ("gyro", "accelerometer") for i in range(3)]
    return {
        "madoc": 1,
        "name": "quadruped",
        "model": "quadruped.xml",
        "control_step": STEP,
        "signals": [
            *({"name": joint, "reads": f"position({joint})"} for joint in JOINTS),
            *({"name": f"{joint}_speed", "reads": f"velocity({joint})"} for joint in JOINTS),
            *({"name": f"{sensor}_{axis}", "reads": f"sensor({sensor})[{i}]"} for sensor, i, axis in parts),
        ],
        "actions": [{"name": f"{joint}_target", "actuator": joint, "low": -3.2, "high": 3.2} for joint in JOINTS],
        "parameters": [
            {"name": name, "field": field, "elements": list(elements), "low": low, "high": high}
            for name, (field, elements, (low, high), _) in FREE.items()
        ],
    }


def walked(
    robot: robots.Robot, truth: dict[str, float], random: np.random.Generator
) -> tuple[Float[np.ndarray, "rows signals"], Float[np.ndarray, "rows joints"]]:
    """Noisy signals and targets of a trot that does not fall; a second in which the robot lands is left out."""
    simulator, settling = simulation.make(robot.task), round(1.0 / STEP)
    system, start = simulator.bind(truth), simulator.initial_state.copy()
    start[2], start[7:19] = 0.29, np.tile(HOME, len(LEGS))
    upright = 0.0
    while upright < UPRIGHT:
        targets = trot(random, settling + round(SECONDS / STEP))
        ease = np.clip(np.arange(settling) / settling - 0.2, 0.0, 1.0)[:, None]
        targets[:settling] = start[7:19] + ease * (targets[settling] - start[7:19])
        after = system.roll_out(start[None, None], targets[None, None] / 3.2)[0, 0]
        states = np.concatenate([start[None], after[:-1]])[settling:]
        upright = float((1.0 - 2.0 * (states[:, 4] ** 2 + states[:, 5] ** 2)).min())
    seen = system.observe(states[None])[0]
    kinds = ["speed" if name.endswith("_speed") else name.rpartition("_")[0] for name in robot.task.signals]
    noise = np.array([0.0 if kind == "attitude" else NOISE.get(kind, NOISE["angle"]) for kind in kinds])
    seen = seen + noise * random.standard_normal(seen.shape)
    first = kinds.index("attitude")
    for quaternion, turn in zip(
        seen[:, first : first + 4], NOISE["attitude"] * random.standard_normal((len(seen), 3)), strict=True
    ):
        mujoco.mju_quatIntegrate(quaternion, turn, 1.0)
    return seen, targets[settling:]


def trot(random: np.random.Generator, rows: int) -> Float[np.ndarray, "rows joints"]:
    """Targets of a trot on the spot, two thirds of the time, on which every joint has slow waves of its own."""
    seconds, targets = STEP * np.arange(rows), np.zeros((rows, len(JOINTS)))
    rates, phases = random.uniform(0.3, 2.5, (len(JOINTS), 4)), random.uniform(0.0, 2.0 * np.pi, (len(JOINTS), 4))
    waves = np.sin(2.0 * np.pi * rates[..., None] * seconds + phases[..., None]).sum(1) / 2.0
    steps = 2.0 * np.pi * (random.uniform(1.3, 1.8) * seconds + 0.1 * np.sin(0.4 * np.pi * seconds))
    walks = np.sin(np.pi * seconds / 3.0 + random.uniform(0.0, 2.0 * np.pi)) > -0.3
    for leg, (name, (_, side)) in enumerate(LEGS.items()):
        lift = walks * np.maximum(np.sin(steps + np.pi * (name in ("FL", "RR"))), 0.0)
        own = waves[3 * leg : 3 * leg + 3]
        targets[:, 3 * leg] = 0.05 * side + 0.08 * own[0]
        targets[:, 3 * leg + 1] = HOME[1] + 0.1 * own[1] + 0.22 * lift
        targets[:, 3 * leg + 2] = HOME[2] + 0.13 * own[2] - 0.45 * lift
    return targets


def table(rows: list[dict[str, Any]]) -> str:
    """How far estimates are from the truth, and how often intervals hold it, as Markdown."""
    lines = ["| parameter | problems | error, median (largest), % | intervals that hold the truth |", "|---" * 4 + "|"]
    solved = [row for row in rows if all(each["interval"] for each in row["parameters"].values())]
    for name in FREE:
        found = [row["parameters"][name] for row in solved]
        errors = [100.0 * abs(each["estimate"] / each["truth"][0] - 1.0) for each in found]
        if errors:
            held = sum(each["miss"] == 0.0 for each in found)
            lines.append(f"| {name} | {len(found)} | {median(errors):.2g} ({max(errors):.2g}) | {held} |")
    words = [row["verdict"] for row in rows]
    counts = ", ".join(f"{words.count(word)} {word}" for word in sorted(set(words)))
    times = ", ".join(f"{row['seconds']:.0f} ({row['processor_seconds']:.0f})" for row in rows)
    return "\n".join([*lines, "", f"Verdicts: {counts}. Seconds (of a processor): {times}. {commits(rows)}"])


if __name__ == "__main__":
    main()
