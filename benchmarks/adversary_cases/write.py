"""A case in files, as a user has them: model, spec, logs. What is true is returned and not written."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from adversary_cases.case import Case
from adversary_cases.plant import Run, control_step, limits_of, record, truth_of

DEGREES = 180.0 / np.pi


@dataclass(frozen=True)
class Problem:
    """What the tool is given, and the answer: of each parameter the smallest and the largest true value."""

    spec: Path
    logs: Path
    truth: dict[str, tuple[float, float]]


def write(case: Case, seed: int, folder: Path) -> Problem:
    """Simulate a case and write its files."""
    truth = truth_of(case, seed)
    spec, logs = describe(case, folder), folder / "logs"
    logs.mkdir(exist_ok=True)
    random = np.random.default_rng([seed, *case.key.encode()])
    for index, (time, table) in enumerate(logged(case, record(case, truth, random), random)):
        rows, header = np.stack([time, *table.values()], axis=-1), ",".join(["time", *table])
        np.savetxt(logs / f"run_{index}.csv", rows, "%.9g", ",", header=header, comments="")
    parts = [{**truth, **part} for part in case.plant.by_run]
    return Problem(spec, logs, {n: (min(part[n] for part in parts), max(part[n] for part in parts)) for n in case.free})


def describe(case: Case, folder: Path) -> Path:
    """Write the model and the spec of a case; the spec's place."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(case.robot.mjcf(user_values(case)))
    spec = folder / f"{case.robot.name}.yaml"
    spec.write_text(yaml.safe_dump(spec_of(case), sort_keys=False, allow_unicode=True))
    return spec


def user_values(case: Case) -> dict[str, float]:
    """Values of the user's model: what is calibrated starts at mid-range, the rest is what the user believes."""
    middle = {name: sum(limits(case, name)) / 2 for name in case.free}
    return {**case.robot.values, **middle, **case.spec.values}


def limits(case: Case, name: str) -> tuple[float, float]:
    """The range of a calibrated value in the spec."""
    free = case.robot.catalogue[name]
    return case.spec.ranges.get(name, (free.low, free.high))


def spec_of(case: Case) -> dict[str, object]:
    """The spec file."""
    robot = case.robot
    parameters = []
    for name in case.free:
        free, (low, high) = robot.catalogue[name], limits(case, name)
        elements = free.element.split()
        element: dict[str, object] = {"element": elements[0]} if len(elements) == 1 else {"elements": elements}
        parameters.append({"field": free.field, **element, "name": name, "low": low, "high": high})
    step = control_step(case)
    spec: dict[str, object] = {
        "madoc": 1,
        "name": robot.name,
        "model": "model.xml",
        "control_step": step,
        "signals": [
            {"name": signal.name, "reads": signal.reads + (" * 180 / pi" if case.spec.degrees else "")}
            | ({"unit": "deg" if signal.kind == "position" else "deg/s"} if case.spec.degrees else {})
            for signal in robot.signals
            if signal.kind == "position" or case.log.velocities != "none"
        ],
        "actions": [action.spec for action in robot.actions],
        "parameters": parameters,
    }
    if step < robot.timestep:
        spec["timestep"] = step
    if case.log.jitter > 0.03:
        spec["log"] = {"tolerance": 0.5}
    return spec


def logged(case: Case, runs: list[Run], random: np.random.Generator) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Time and columns of each run as its logger writes them."""
    log, nominal = case.log, control_step(case)
    tables = []
    for run in runs:
        table = columns_of(case, run, random)
        time = nominal * np.arange(len(run.time)) if log.nominal_time else run.time
        time = time + log.jitter * nominal * random.uniform(-0.5, 0.5, len(time))
        kept = random.random(len(time)) >= log.dropped
        time = time[: kept.sum()] if log.nominal_time else time[kept]
        tables.append((time, {name: column[kept] for name, column in table.items()}))
    return tables


def columns_of(case: Case, run: Run, random: np.random.Generator) -> dict[str, np.ndarray]:
    """Signals and commands of a run by the names of their columns."""
    log, robot = case.log, case.robot
    positions = np.array([signal.kind == "position" for signal in robot.signals])
    signals = run.signals.copy()
    if log.positions == "filtered":
        signals[:, positions] = filtered(signals[:, positions], run.time, log.filter)
    signals[:, ~positions] = velocities(case, run.time, signals)
    low, high = limits_of(robot)
    commands = run.commands + log.action_noise * (high - low) / 2 * random.standard_normal(run.commands.shape)
    table = {
        signal.name: column * (DEGREES if log.degrees else 1.0)
        for signal, column in zip(robot.signals, signals.T, strict=True)
        if signal.kind == "position" or log.velocities != "none"
    }
    table |= {action.name: column for action, column in zip(robot.actions, np.clip(commands, low, high).T, strict=True)}
    table = {name: altered(case, name, column) for name, column in table.items()}
    if log.swap:
        first, second = log.swap
        table |= {first: table[second], second: table[first]}
    return table


def velocities(case: Case, time: np.ndarray, signals: np.ndarray) -> np.ndarray:
    """Logged velocities: as read, differences of the positions before, or behind a filter of first order."""
    positions = np.array([signal.kind == "position" for signal in case.robot.signals])
    measured = signals[:, ~positions]
    if case.log.velocities == "differenced":
        return np.diff(signals[:, positions], axis=0, prepend=signals[:1, positions]) / np.median(np.diff(time))
    if case.log.velocities == "filtered":
        return filtered(measured, time, case.log.filter)
    return measured


def filtered(columns: np.ndarray, time: np.ndarray, constant: float) -> np.ndarray:
    """Columns behind a filter of first order with this time constant in s, which begins at the first row."""
    keep = np.exp(-np.median(np.diff(time)) / constant)
    behind = columns.copy()
    for row in range(1, len(behind)):
        behind[row] = keep * behind[row - 1] + (1.0 - keep) * columns[row]
    return behind


def altered(case: Case, name: str, column: np.ndarray) -> np.ndarray:
    """A column with its factor, its offset and its limit."""
    limit = case.log.clip.get(name, np.inf)
    return np.clip(column * case.log.scale.get(name, 1.0) + case.log.offset.get(name, 0.0), -limit, limit)
