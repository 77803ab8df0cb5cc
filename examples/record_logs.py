"""Logs of a pretended machine: a robot of a spec file, moved under true parameters that nobody else is told.

    python examples/record_logs.py examples/arm/arm.yaml examples/arm/truth.json logs

Leaves a CSV file a run, with a column `time` and one for each signal and action of the spec.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from madoc import robots, simulation


def main() -> None:
    """Record, write, tell."""
    parser = argparse.ArgumentParser()
    parser.add_argument("spec", type=Path)
    parser.add_argument("truth", type=Path, help="JSON {parameter: value}")
    parser.add_argument("out", type=Path, help="folder")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=8.0, help="of each run")
    parser.add_argument("--noise", type=float, default=0.002, help="of sensors, as a share of each signal's spread")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    robot = robots.load(arguments.spec)
    truth = json.loads(arguments.truth.read_text())
    random = np.random.default_rng(arguments.seed)
    rows = round(arguments.seconds / robot.spec.control_step)
    arguments.out.mkdir(parents=True, exist_ok=True)
    runs = record(robot, truth, rows, runs=arguments.runs, noise=arguments.noise, random=random)
    for run, columns in enumerate(runs):
        file = arguments.out / f"run_{run}.csv"
        np.savetxt(file, np.stack(list(columns.values()), -1), "%.9g", ",", header=",".join(columns), comments="")
        print(f"{file}: {rows} rows")


def record(
    robot: robots.Robot, truth: dict[str, float], rows: int, *, runs: int, noise: float, random: np.random.Generator
) -> list[dict[str, np.ndarray]]:
    """Columns of runs from rest, pushed by commands that change every tenth of a second; all have the same sensors."""
    simulator = simulation.make(robot.task)
    system = simulator.bind(simulator.parameters.vector(truth)[None])
    held = max(1, round(0.1 / robot.spec.control_step))
    draws = random.uniform(-1.0, 1.0, (runs, rows // held + 1, len(robot.actions)))
    commands = np.repeat(draws, held, axis=1)[:, :rows]
    state, seen = np.repeat(simulator.initial_state[None, None], runs, axis=1), []
    for command in np.swapaxes(commands, 0, 1):
        seen.append(np.asarray(system.observe(state))[0])
        state = system.step(state, command[None])
    signals = np.stack(seen, axis=1)
    signals += noise * signals.std(axis=(0, 1)) * random.standard_normal(signals.shape)
    low, high = (np.array([getattr(channel, end) for channel in robot.actions]) for end in ("low", "high"))
    names = ("time", *(channel.name for channel in (*robot.signals, *robot.actions)))
    times, actions = robot.spec.control_step * np.arange(rows), low + (commands + 1) / 2 * (high - low)
    values = ((times, *signals[run].T, *actions[run].T) for run in range(runs))
    return [dict(zip(names, each, strict=True)) for each in values]


if __name__ == "__main__":
    main()
