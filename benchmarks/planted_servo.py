"""A geared servo on a pendulum, all of it unknown: supply limit, back-EMF, friction by speed and load, backlash.

    python benchmarks/planted_servo.py --seeds 0 1 2
    python benchmarks/planted_servo.py --table

The truth of each problem is drawn about that of a hobby servo of 7.4 V (Rhoban/bam's fit of the STS3215): torque
constant, resistance, inertia of the motor, friction M4, stiffness of the gear and a backlash of about one degree, read
by an encoder on the link. Runs are the tool's own simulation, as no other program has all of these terms, at two gains
of the firmware: sums of sines, steps that the supply limits, and falls with the drive off. 100 rows a second have the
position alone, with noise. Everything drawn is calibrated, with all defaults, in the ranges of `RANGES`.
"""

import json
import tempfile
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from adversary import solved
from kept import RESULTS, Study, commits, run_seeds

from madoc import robots
from madoc.simulation.cpu import CpuSimulator

STUDY = Study(RESULTS / "planted_servo.jsonl", ("seed",))
RANGES: dict[str, tuple[float, float, float]] = {
    "drive_kt.target": (1.2, 0.6, 2.0),
    "drive_resistance.target": (2.7, 1.5, 4.5),
    "dof_armature.shaft": (0.028, 0.01, 0.06),
    "dof_frictionloss.shaft": (0.05, 0.0, 0.3),
    "dof_damping.shaft": (0.06, 0.0, 0.3),
    "friction_stribeck.shaft": (0.08, 0.0, 0.3),
    "friction_stribeck_speed.shaft": (0.5, 0.1, 3.0),
    "friction_load.shaft": (0.15, 0.0, 0.5),
    "friction_stribeck_load.shaft": (0.1, 0.0, 0.5),
    "gear_backlash.shaft": (0.0175, 0.0, 0.06),
    "gear_stiffness.shaft": (120.0, 40.0, 300.0),
}
"""Middle of the truths, and the range, by parameter."""
SPREAD = 0.25
"""Standard deviation of the logarithm of a truth."""
EDGE = 0.03
"""Share of a range at either end in which no truth lies."""
NOISE, ROW, LIMIT = 5e-4, 0.01, 1500.0
"""rad, s, s."""
GAINS, RUNS, SECONDS = (16, 32), 4, 5.0
KINDS = ("sines", "sines", "steps", "falls")
MODEL = """\
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="rod" pos="0 0 1">
      <joint name="shaft" axis="0 1 0" armature="0.028" solimpfriction="0.99 0.999 0.001"/>
      <inertial pos="0 0 -0.15" mass="1" diaginertia="1e-3 1e-3 1e-3"/>
      <geom size=".02" pos="0 0 -0.15" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
SPEC = """\
madoc: 1
name: servo
model: servo.xml
control_step: 0.01
signals:
  - {name: angle, reads: position(shaft), unit: rad}
actions:
  - name: target
    joint: shaft
    means: position
    low: -3.2
    high: 3.2
    unit: rad
    drive: {kind: dc, supply: 7.4, kt: 1.2, resistance: 2.7, gain: 0.166, gain_from: P, enable: "on"}
conditions:
  - {name: P, values: [16, 32], file_name: P*_}
friction:
  - {joint: shaft, model: M4, up_to: 0.3, stribeck_exponent: 1}
gears:
  - {joint: shaft, stiffness: 120, damping: 0.2, backlash: 0.0175, encoder: link}
parameters:
"""


def solve(seed: int) -> dict[str, Any]:
    """Record, calibrate and compare."""
    random = np.random.default_rng(seed)
    truth = drawn(random)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        recorded(folder, truth, random)
        return {"seed": seed} | solved(folder / "servo.yaml", folder / "logs", truth, limit=LIMIT)


def drawn(random: np.random.Generator) -> dict[str, float]:
    """A truth, each value of which is drawn anew until it is off the ends of its range."""
    truth = {}
    for name, (middle, low, high) in RANGES.items():
        off = EDGE * (high - low)
        while not low + off <= (value := middle * np.exp(SPREAD * random.standard_normal())) <= high - off:
            pass
        truth[name] = float(value)
    return truth


def recorded(folder: Path, truth: dict[str, float], random: np.random.Generator) -> None:
    """The robot's files, and its logs at the true parameters."""
    (folder / "logs").mkdir()
    (folder / "servo.xml").write_text(MODEL)
    lines = [
        "  - " + json.dumps(dict(zip(("field", "element"), name.split("."), strict=True)) | {"low": low, "high": high})
        for name, (_, low, high) in RANGES.items()
    ]
    (folder / "servo.yaml").write_text(SPEC + "\n".join(lines) + "\n")
    simulator = CpuSimulator(robots.load(folder / "servo.yaml").task, threads=1)
    system, (middle, half) = simulator.bind(truth), simulator.task.action_ranges
    columns = [channel.name for channel in simulator.task.actions]
    for run in range(RUNS * len(GAINS)):
        gain, given = GAINS[run % len(GAINS)], np.zeros((round(SECONDS / ROW), len(columns)))
        target, on = commands(KINDS[run // len(GAINS)], random)
        for name, value in {"target": target, "on": on, "P": gain}.items():
            given[:, columns.index(name)] = value
        start = simulator.initial_state[None, None]
        after = system.roll_out(start, ((given - middle) / half)[None, None])[0, 0]
        states = np.concatenate([start[0], after[:-1]])
        read = system.observe(states[None])[0, :, 0] + NOISE * random.standard_normal(len(states))
        rows = np.column_stack([ROW * np.arange(len(read)), read, target, on])
        np.savetxt(
            folder / "logs" / f"P{gain}_{run}.csv", rows, "%.9g", ",", header="time,angle,target,on", comments=""
        )


def commands(kind: str, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Targets in rad, and whether the drive is on, in every row of a run."""
    now = ROW * np.arange(round(SECONDS / ROW))
    on = np.ones_like(now)
    if kind == "sines":
        size, speed, phase = random.uniform(0.1, 0.5, 4), random.uniform(0.5, 8.0, 4), random.uniform(0.0, 6.3, 4)
        return (size[:, None] * np.sin(speed[:, None] * now + phase[:, None])).sum(0), on
    target = random.uniform(-1.6, 1.6, 10)[np.minimum((now / 0.5).astype(int), 9)]
    if kind == "falls":
        on[(now % 2.5) > 1.0] = 0.0
    return target, on


def table(rows: list[dict[str, Any]]) -> str:
    """Errors, widths, and how many intervals hold the truth, as Markdown."""
    lines = [
        "| value | problems | error, % of the range, median | largest | half-width, median | intervals that hold |",
        "|---" * 6 + "|",
    ]
    held_of, all_of = 0, 0
    for name, (_, low, high) in RANGES.items():
        found = [one for row in rows if (one := row["parameters"][name])["interval"]]
        percent = 100.0 / (high - low)
        errors = [percent * abs(one["estimate"] - one["truth"][0]) for one in found] or [float("nan")]
        widths = [percent * (one["interval"][1] - one["interval"][0]) / 2.0 for one in found] or [float("nan")]
        held = sum(one["miss"] == 0.0 for one in found)
        held_of, all_of = held_of + held, all_of + len(found)
        lines.append(
            f"| {name} | {len(rows)} | {median(errors):.2g} | {max(errors):.2g} | {median(widths):.2g} "
            f"| {held} of {len(found)} |"
        )
    words = [row["verdict"] for row in rows]
    counted = ", ".join(f"{words.count(word)} {word}" for word in sorted(set(words)))
    seconds = median([row["seconds"] for row in rows] or [0.0])
    share = f"{100.0 * held_of / max(1, all_of):.0f} % of {all_of} intervals hold the truth"
    return "\n".join([*lines, "", f"{share}. Verdicts: {counted}; {seconds:.0f} s a problem; {commits(rows)}."])


if __name__ == "__main__":
    run_seeds(STUDY, solve, table, description=__doc__)
