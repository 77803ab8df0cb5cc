"""A Dynamixel XL330 of hardware: how well runs that were never shown are predicted, beside the published models.

    python benchmarks/real_servo.py --data FOLDER [--held-out 400] [--friction M5] [--set horizon=200 loss=linear]

FOLDER holds the CSV files that docs/real-servo.md says where from. Calibrated to the runs of the other gains of the
firmware; those of the gain held out are simulated from the measured state, over windows of one second and as a whole,
with the logged supply. The published models were fitted by their makers to runs of all gains, these among them.
"""

import argparse
import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from kept import RESULTS, Study
from ruamel.yaml import YAML

from madoc import pipeline, robots, simulation
from madoc.data import logs

STUDY = Study(RESULTS / "real_servo.jsonl", ("held_out", "friction", "set"))
SERVO = Path(__file__).parents[1] / "examples" / "xl330"
WINDOW = 200
"""Length of a window in control steps of 5 ms."""
SLOPE = 4
"""Rows before and after the first of a window over which the velocity there is measured."""
BUDGET = "600s"
DRIVE = {"kt": "drive_kt.goal", "resistance": "drive_resistance.goal"}
DRIVE |= {"armature": "dof_armature.shaft", "zero": "jnt_ref.shaft"}
TERMS = ("coulomb", "viscous", "stribeck", "stribeck_speed", "stribeck_exponent", "load_motor", "load_external")
TERMS += ("stribeck_load_motor", "stribeck_load_external", "quadratic_motor", "quadratic_external")
PUBLISHED = {
    "M1": {"kt": 0.3867, "resistance": 4.017, "armature": 0.001814, "zero": -0.0309}
    | dict(zip(TERMS, (0.01283, 0.00366), strict=False)),
    "M6": {"kt": 0.3660, "resistance": 2.811, "armature": 0.001808, "zero": -0.0271}
    | dict(
        zip(
            TERMS,
            (0.00477, 0.00536, 0.00468, 2.890, 8.683, 0.2668, 0.00001, 0.00001, 0.0808, 0.00997, 0.00490),
            strict=True,
        )
    ),
}
"""Rhoban/bam, bam/params/xl330 at 1b5a1ce, in SI units; the zero with the sign of `jnt_ref`."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--held-out", type=int, choices=(200, 400, 800), default=400)
    parser.add_argument("--friction", choices=("M1", "M2", "M3", "M4", "M5", "M6"), default="M5")
    parser.add_argument("--set", nargs="*", default=[], help="hyperparameters of least squares")
    arguments = parser.parse_args()
    found = compare(arguments.data, arguments.held_out, arguments.friction, tuple(arguments.set))
    STUDY.add(found)
    print(json.dumps(found, indent=1))


def compare(data: Path, held_out: int, friction: str, settings: tuple[str, ...] = ()) -> dict:
    """The estimate and its verdict, and errors of the runs held out: ours, mid-range's and the published models'."""
    files = sorted(data.glob("gain*.csv"))
    unseen = [file for file in files if file.stem.startswith(f"gain{held_out}_")]
    with tempfile.TemporaryDirectory() as folder:
        spec = written(Path(folder), friction)
        runs = Path(folder) / "runs"
        runs.mkdir()
        for file in set(files) - set(unseen):
            shutil.copy(file, runs)
        order = pipeline.CalibrationOrder(
            task=str(spec),
            source=pipeline.Source((str(runs),)),
            search=pipeline.Search(method="least-squares", budget=BUDGET, set=(settings,)),
            holdout=0.2,
        )
        result = pipeline.calibrate_in(Path(folder) / "run", order).to_json()
        estimates = {name: row["estimate"] for name, row in result["parameters"].items()}
        robot = robots.load(spec)
        middle = dict(zip(robot.task.parameters.names, robot.task.parameters.middle.tolist(), strict=True))
        errors = {"madoc": errors_of(robot, estimates, unseen), "mid-range": errors_of(robot, middle, unseen)}
        for name, values in PUBLISHED.items():
            errors[f"published {name}"] = errors_of(robots.load(written(Path(folder), name, values)), {}, unseen)
    kept = ("status", "parameters", "verdict", "warnings", "control_steps", "seconds")
    return {
        "held_out": held_out,
        "friction": friction,
        "set": list(settings),
        "unit": "rad, root mean square error of the angle: windows of 1 s, whole run",
        **{name: result[name] for name in kept if name in result},
        "errors": errors,
    }


def written(folder: Path, friction: str, values: Mapping[str, float] | None = None) -> Path:
    """The example's spec with a model of friction, beside its model; with values, all of its numbers are given."""
    document = YAML(typ="safe").load(SERVO / "xl330.yaml")
    document["friction"][0]["model"] = friction
    if friction in ("M1", "M3") or values is not None:
        del document["friction"][0]["stribeck_exponent"]
    if values is not None:
        drive = document["actions"][0]["drive"]
        drive |= {name: values[name] for name in ("kt", "resistance")} | {"saturation": 0.0}
        document["friction"][0] |= {name: values[name] for name in TERMS if name in values}
        ends = {name: (0.999 * values[name], 1.001 * values[name]) for name in ("armature", "zero")}
        document["parameters"] = [
            {"field": field, "element": "shaft", "low": min(ends[name]), "high": max(ends[name])}
            for field, name in (("dof_armature", "armature"), ("jnt_ref", "zero"))
        ]
    shutil.copy(SERVO / "pendulum.xml", folder)
    place = folder / f"{friction}{'-published' if values else ''}.yaml"
    YAML(typ="safe").dump(document, place)
    return place


def errors_of(robot: robots.Robot, values: Mapping[str, float], files: list[Path]) -> dict[str, list[float]]:
    """By run the error over windows of a second and that of the whole run; without values those of mid-range."""
    simulator = simulation.make(robot.task)
    space, found = robot.task.parameters, {}
    system = simulator.bind(space.vector(values) if values else space.middle)
    for file in files:
        logged = logs.read(file, robot).transitions
        angle = np.append(np.asarray(logged.observation)[:, 0], np.asarray(logged.next_observation)[-1, 0])
        action = np.asarray(logged.action, np.float64)
        first = np.arange(SLOPE, len(action) - WINDOW, WINDOW)
        speed = (angle[first + SLOPE] - angle[first - SLOPE]) / (2 * SLOPE * simulator.control_step)
        rows = first[:, None] + np.arange(WINDOW)
        short = system.roll_out(np.stack([angle[first], speed], axis=-1)[None], action[rows][None])[0, :, :, 0]
        whole = system.roll_out(np.array([[[angle[0], 0.0]]]), action[None, None])[0, 0, :, 0]
        found[file.stem] = [rms(short - angle[rows + 1]), rms(whole - angle[1:])]
    return found


def rms(error: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(error**2)))


if __name__ == "__main__":
    main()
