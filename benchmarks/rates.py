"""One log of a double pendulum at 500, 100 and 50 rows a second: do estimates agree, and what are they worth?

    python benchmarks/rates.py --seeds 0 1 2
    python benchmarks/rates.py --table

The arm of the adversary, six of its values unknown, commands held for 0.2 s. Encoders of 12 bits are all that is read,
speeds are differences of them at 500 Hz, and torque is known from noisy currents. Every tenth row makes the log at
50 Hz. The tool runs with its defaults. Its estimate is then simulated by MuJoCo alone from the true states of two other
runs, over windows of 0.5 s, as are mid-range and values 5 % off the truth, as a maker's data sheet may be.
"""

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import mujoco
import numpy as np
import yaml
from adversary import compared, madoc
from adversary_cases.case import ENCODER, Case, Log, Spec
from adversary_cases.plant import Run, record_run, truth_of
from adversary_cases.robots import ARM
from adversary_cases.write import limits, write
from kept import RESULTS, Study, commit, commits, run_seeds

STUDY = Study(RESULTS / "rates.jsonl", ("seed",))
RATES = (500, 100, 50)
"""Rows per second. All are calibrated with a physics step of 2 ms."""
FREE = ("mass_upper", "mass_fore", "damping_shoulder", "damping_elbow", "friction_shoulder", "friction_elbow")
CASE = Case(
    ARM,
    "rates",
    log=Log(runs=6, seconds=6.0, noise=0.0, action_noise=0.01, quantum=ENCODER, velocities="differenced"),
    spec=Spec(rate=RATES[0], free=FREE),
)
WINDOW = 0.5
"""s, of open loop."""
SHEET = 0.05
"""Error of a maker's data sheet, as a share of each value; its sign is drawn."""
LIMIT = 300.0
"""s, of one calibration."""


def solve(seed: int) -> dict[str, Any]:
    """Calibrate to the same runs at every rate."""
    row: dict[str, Any] = {"seed": seed, "commit": commit(), "rates": {}}
    truth, random = truth_of(CASE, seed), np.random.default_rng([seed, 1])
    exact = replace(CASE, log=Log(seconds=6.0, noise=0.0))
    apart = [record_run(exact, truth, 0.0, random) for _ in range(2)]
    row["errors"] = {
        "mid-range": error({**truth, **{name: sum(limits(CASE, name)) / 2 for name in FREE}}, apart),
        "data sheet": error({**truth, **{n: truth[n] * (1 + SHEET * random.choice([-1, 1])) for n in FREE}}, apart),
    }
    with tempfile.TemporaryDirectory() as temporary:
        for rate in RATES:
            folder = Path(temporary) / str(rate)
            problem = write(CASE, seed, folder)
            thin(problem.spec, problem.logs, rate)
            started = time.monotonic()
            words = ["calibrate", str(problem.spec), "--data", str(problem.logs), "--json", "--quiet"]
            _, result, complaint = madoc(*words, "--out", str(folder / "out"), limit=LIMIT)
            parameters = {
                name: compared(result.get("parameters", {}).get(name, {}), problem.truth[name]) for name in FREE
            }
            estimate = {name: each["estimate"] for name, each in parameters.items()}
            row["rates"][str(rate)] = {
                "verdict": (result.get("verdict") or {}).get("word", complaint),
                "sentence": (result.get("verdict") or {}).get("sentence"),
                "seconds": round(time.monotonic() - started, 1),
                "parameters": parameters,
                "error": error({**truth, **estimate}, apart) if None not in estimate.values() else None,
            }
    return row


def thin(spec: Path, logs: Path, rate: int) -> None:
    """Keep the rows of a lower rate."""
    every = RATES[0] // rate
    document = yaml.safe_load(spec.read_text())
    spec.write_text(yaml.safe_dump({**document, "control_step": 1.0 / rate, "timestep": 1.0 / RATES[0]}))
    for path in logs.glob("*.csv"):
        header = path.read_text().partition("\n")[0]
        rows = np.loadtxt(path, delimiter=",", skiprows=1)[::every]
        np.savetxt(path, rows, "%.9g", ",", header=header, comments="")


def error(values: dict[str, float], runs: list[Run]) -> float:
    """Root mean square error of the angles, rad, over all windows of the runs, commands replayed from true states."""
    model = mujoco.MjModel.from_xml_string(ARM.mjcf(values))
    model.opt.timestep = 1.0 / RATES[0]
    data, squares, length = mujoco.MjData(model), list[float](), round(WINDOW * RATES[0])
    for run in runs:
        for first in range(0, len(run.time) - length, length):
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = run.signals[first, : model.nq], run.signals[first, model.nq :]
            for row in range(first, first + length):
                data.ctrl[:] = run.commands[row]
                mujoco.mj_step(model, data)
                squares.append(float(np.mean((data.qpos - run.signals[row + 1, : model.nq]) ** 2)))
    return float(np.sqrt(np.mean(squares)))


def table(rows: list[dict[str, Any]]) -> str:
    """Verdicts, errors, and how far estimates at two rates are apart, as Markdown."""
    lines = [
        "| rows a second | seeds | CALIBRATED | intervals that hold the truth | s | error after 0.5 s, rad "
        "| error over the data sheet's | over mid-range's | half-widths from 500 Hz, median (largest) | commits |",
        "|---" * 10 + "|",
    ]
    for rate in map(str, RATES):
        all_of = [row["rates"][rate] for row in rows]
        solved = [(row, row["rates"][rate]) for row in rows if row["rates"][rate]["error"] is not None]
        found = [one for _, each in solved for one in each["parameters"].values() if one["interval"]]
        apart = [
            abs(one["estimate"] - other["estimate"]) / max(map(half_width, (one, other)))
            for row, each in solved
            for one, other in zip(
                each["parameters"].values(), row["rates"][str(RATES[0])]["parameters"].values(), strict=True
            )
            if one["interval"] and other["interval"]
        ]
        if not solved:
            lines.append(f"| {rate} | {len(all_of)} | 0 | not run |  |  |  |  |  | {commits(rows)} |")
            continue
        ratio = {
            name: median(each["error"] / row["errors"][name] for row, each in solved)
            for name in ("data sheet", "mid-range")
        }
        lines.append(
            f"| {rate} | {len(all_of)} | {sum(each['verdict'] == 'CALIBRATED' for each in all_of)} "
            f"| {sum(one['miss'] == 0.0 for one in found)} of {len(found)} "
            f"| {median(each['seconds'] for each in all_of):.0f} "
            f"| {median(each['error'] for _, each in solved):.2g} | {ratio['data sheet']:.2f} "
            f"| {ratio['mid-range']:.3f} | {f'{median(apart):.2f} ({max(apart):.2f})' if apart else ''} "
            f"| {commits(rows)} |"
        )
    return "\n".join(lines)


def half_width(parameter: dict[str, Any]) -> float:
    """Half of the 95 % interval."""
    low, high = parameter["interval"]
    return float(high - low) / 2


if __name__ == "__main__":
    run_seeds(STUDY, solve, table, description=__doc__)
