"""Least squares beside MuJoCo's own system identification, `mujoco.sysid`, on the same planted problems.

    python benchmarks/against_sysid.py                              # 2 robots in 2 situations

Both get the logs, the ranges and the middle of them to start from; rows already there are skipped. `mujoco.sysid` has
its default optimizer, residuals and intervals, and runs both whole and in stretches; counted is what leaves the smaller
residual, and only the seconds that this took. The tools take turns, and times are medians of those after the first, in
which Python loads what they need. Madoc's are of the whole order, which checks the log and leaves a run folder, and of
solving alone, which is what `mujoco.sysid` does. The hopper is left to `--robots hopper`: four minutes of core time,
both tools together, had not brought its first problem to an end when it was stopped.
"""

import argparse
import logging
import tempfile
import time
from functools import partial
from io import StringIO
from pathlib import Path

import mujoco
import numpy as np
from kept import SYSID
from mujoco import sysid
from planted import NOISE, TRUTHS, base, compared, record, write

from madoc import robots
from madoc.pipeline import CalibrationOrder, Search, Source, calibrate_in
from madoc.tasks import Task

if not hasattr(sysid, "optimize"):
    raise SystemExit('mujoco.sysid lacks packages that it needs; pip install "mujoco[sysid]" brings them')

BUDGET = 1_000_000
REPEATS = 3
"""Runs of each tool whose times count."""
STRETCH, MOST_STRETCHES = 20, 200
"""Control steps of a stretch, and how many stretches are used."""
TIMES = ("seconds", "core_seconds", "solving")
CLEARLY = 0.9
"""Stretches are counted where their residual is below this share of whole runs': these are quicker, if as good."""
ROUNDING = 1.0 - 1e-12
"""Of times: `mujoco.sysid` rounds durations up to whole timesteps, and one too many would shift all commands."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", nargs="+", default=["pendulum", "arm"], choices=list(TRUTHS))
    parser.add_argument("--situations", nargs="+", default=["exact", "noise"], choices=["exact", "noise"])
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    logging.getLogger("absl").setLevel("ERROR")  # it warns of every piece that its signals are no sensors
    for robot in arguments.robots:
        for situation in arguments.situations:
            asked = {"robot": robot, "situation": situation, "seed": arguments.seed}
            with SYSID.claimed(asked) as ours, tempfile.TemporaryDirectory() as folder:
                if not ours:
                    continue
                row = both(Path(folder), robot, situation, arguments.seed)
                SYSID.add(asked | row)
            for tool in ("madoc", "sysid"):
                worst = f"worst {row[tool]['worst']:.2g} %"
                print(robot, situation, tool, f"{row[tool]['seconds']:.0f} s, {worst}", flush=True)


def both(folder: Path, robot: str, situation: str, seed: int) -> dict:
    """What each tool makes of the same logs."""
    machine, truth = base(robot), TRUTHS[robot]
    logs = record(folder, machine, truth, noise=NOISE if situation == "noise" else 0.0, seed=seed)
    spec = write(folder / "known.yaml", machine)
    search = Search(method="least-squares", budget=BUDGET, seed=seed)
    order = CalibrationOrder(str(spec), Source((str(logs),)), search)
    task = robots.load(spec).task
    runs = [np.genfromtxt(file, delimiter=",", names=True) for file in sorted(logs.glob("*.csv"))]
    ours, theirs = [], list[dict[int | None, dict]]()
    for repeat in range(1 + REPEATS):
        start = clocks()
        result = calibrate_in(folder / f"run-{repeat}", order).to_json()
        told = summary(result, truth, clocks() - start)
        ours.append(told | {"solving": result["seconds"], "control_steps": result["control_steps"]})
        theirs.append({length: identified(task, machine, truth, runs, length) for length in (None, STRETCH)})
    whole, cut = (timed([each[length] for each in theirs]) for length in (None, STRETCH))
    tried = {"whole runs": whole, f"stretches of {STRETCH} control steps": cut}
    better = list(tried)[cut["residual"] < CLEARLY * whole["residual"]]
    found = {"madoc": timed(ours), "sysid": {"cut": better, **tried.pop(better)}}
    return {**found, "not_counted": tried}


def timed(rows: list[dict]) -> dict:
    """The last of several runs that differ in nothing but time, with the median of those after the first."""
    clocked = {key: float(np.median([row[key] for row in rows[1:]])) for key in TIMES if key in rows[0]}
    return rows[-1] | clocked


def identified(task: Task, machine: dict, truth: dict, runs: list[np.ndarray], stretch: int | None) -> dict:
    """What `mujoco.sysid` finds in whole runs, or in stretches of so many control steps."""
    start = clocks()
    spec = prepared(task.spec())
    length = stretch or min(map(len, runs)) - 1
    pieces = [run[at : at + length + 1] for run in runs for at in range(0, len(run) - length, length)]
    kept = np.linspace(0, len(pieces) - 1, min(MOST_STRETCHES, len(pieces))).round().astype(int)
    data = sequences(spec, task.frame_skip, machine, [pieces[index] for index in kept])
    unknown = sysid.ParameterDict()
    for row in task.parameters.parameters:
        modifier = partial(modify, row.field, row.elements[0])
        unknown.add(sysid.Parameter(row.name, (row.low + row.high) / 2, row.low, row.high, modifier=modifier))
    residual = sysid.build_residual_fn(models_sequences=[data])
    told = StringIO()
    best, ended = sysid.optimize(unknown, residual, verbose=False, output=told)
    found, predicted, measured = residual(ended.x, best)
    _, widths = sysid.calculate_intervals(found, ended.jac)
    seconds, rows = clocks() - start, {}
    for row, value, width in zip(task.parameters.parameters, ended.x.tolist(), widths.tolist(), strict=True):
        interval = [value - width, value + width]
        rows[row.name] = {"estimate": value, "interval": interval, "low": row.low, "high": row.high, "unit": row.unit}
    seen = [np.concatenate([part.data for group in groups for part in group]) for groups in (measured, predicted)]
    off = float(np.sqrt(np.mean(((seen[0] - seen[1]) / seen[0].std(axis=0)) ** 2)))
    ending = told.getvalue().partition("Terminated ")[2].partition(" y:")[0]
    return summary({"parameters": rows}, truth, seconds) | {"residual": off, "pieces": len(kept), "ended": ending}


def sequences(spec: mujoco.MjSpec, frame_skip: int, machine: dict, pieces: list[np.ndarray]) -> sysid.ModelSequences:
    """Logged pieces: the state that each begins with, its commands by physics steps, and the states after it."""
    model = spec.compile()
    joints = [model.joint(index).name for index in range(model.njnt)]
    kinds = {"position": sysid.SignalType.MjStateQPos, "velocity": sysid.SignalType.MjStateQVel}
    named = {signal["reads"]: signal["name"] for signal in machine["signals"]}
    signals = [named[f"{kind}({joint})"] for kind in kinds for joint in joints]
    named = {action["actuator"]: action["name"] for action in machine["actions"]}
    actions = [named[model.actuator(index).name] for index in range(model.nu)]
    starts, controls, states = [], [], []
    for piece in pieces:
        values, commands = (np.stack([piece[name] for name in names], axis=-1) for names in (signals, actions))
        held = np.repeat(commands, frame_skip, axis=0)[: (len(piece) - 1) * frame_skip + 1]
        times = ROUNDING * model.opt.timestep * np.arange(len(held))
        seen = [(joint, kind) for kind in kinds.values() for joint in joints]
        controls.append(sysid.TimeSeries.from_control_names(times, held, model))
        states.append(sysid.TimeSeries.from_names(times[::frame_skip], values, model, seen))
        starts.append(sysid.create_initial_state(model, *np.split(values[0], 2)))
    labels = [str(index) for index in range(len(pieces))]
    return sysid.ModelSequences("known", spec, labels, starts, controls, states, allow_missing_sensors=True)


def prepared(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Nothing that is only seen, and bodies that keep their inertia when their mass changes, as Madoc's `body_mass`."""
    model = spec.compile()
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    for body in spec.bodies[1:]:
        has = model.body(body.name)
        body.explicitinertial, body.mass, body.fullinertia = True, has.mass[0], np.full(6, np.nan)
        body.ipos, body.iquat, body.inertia = has.ipos, has.iquat, has.inertia
    for geom in spec.geoms:
        geom.material = ""
    return sysid.remove_visuals(spec)


def modify(field: str, element: str, spec: mujoco.MjSpec, parameter: sysid.Parameter) -> None:
    """Write a value where Madoc writes it."""
    value = float(parameter.value[0])
    if field == "body_mass":
        spec.body(element).mass = value
    elif field == "body_com":
        spec.body(element).ipos *= value / np.linalg.norm(spec.body(element).ipos)
    elif field == "actuator_gain":
        spec.actuator(element).gainprm[0] = value
    elif field == "dof_damping":
        spec.joint(element).damping[0] = value
    elif field == "dof_frictionloss":
        spec.joint(element).frictionloss = value
    else:
        raise ValueError(f"expected a field of the planted robots, got {field!r}; write down here what it changes")


def clocks() -> np.ndarray:
    """Seconds on the wall and of all cores."""
    return np.array([time.monotonic(), time.process_time()])


def summary(result: dict, truth: dict[str, float], seconds: np.ndarray) -> dict:
    """Seconds, and errors and half widths of intervals in % of each parameter's range."""
    found = compared(result, truth)
    errors = [row["percent_of_range"] for row in found.values()]
    halves = [50 * np.ptp(row["interval"]) / (row["high"] - row["low"]) for row in result["parameters"].values()]
    return {
        "seconds": float(seconds[0]),
        "core_seconds": float(seconds[1]),
        "worst": max(errors),
        "mean": float(np.mean(errors)),
        "covered": sum(row["covered"] for row in found.values()),
        "half_width": float(np.median(halves)),
        "parameters": found,
    }


if __name__ == "__main__":
    main()
