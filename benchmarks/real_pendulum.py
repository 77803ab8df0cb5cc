"""A pendulum of hardware: how well it is predicted by what Madoc finds, and by the parameters its makers published.

    python benchmarks/real_pendulum.py --data FOLDER

FOLDER holds the makers' logs and parameters, `control_method_*/data_measured.csv` and `parameters/*.yaml`, as
examples/pendulum/pendulum.yaml says where. Calibrated to the run under iLQR alone; the runs under DDP, energy shaping
and SAC are predicted. Both sets of parameters are put into the same model.
"""

import argparse
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np
from kept import RESULTS, Study
from ruamel.yaml import YAML

from madoc import pipeline, robots, simulation
from madoc.data import Dataset, logs
from madoc.identification.replay import window_residuals
from madoc.identification.states import logged_states
from madoc.identification.windows import first_rows, windows_at

ROOT = Path(__file__).parent
STUDY = Study(RESULTS / "real_pendulum.jsonl", ())
"""One row for each time that it was run."""
PENDULUM = ROOT.parent / "examples" / "pendulum"
CALIBRATED_TO, HELD_OUT = "ilqr", ("ddp", "energy_shaping", "sac")
HORIZON = 20


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, required=True)
    arguments = parser.parse_args()
    found = compare(arguments.data)
    STUDY.add(found)
    print(json.dumps(found, indent=1))


def compare(data: Path) -> dict:
    """Estimates, verdict, and angle errors after 0.4 s of every set of parameters in every run held out."""
    with tempfile.TemporaryDirectory() as folder:
        result = calibrated(data, Path(folder))
    robot = robots.load(PENDULUM / "everything.yaml")
    known = {"mass": 0.6755}
    candidates = {"madoc": known | estimate_of(result)} | published(data / "parameters")
    errors = {
        run: {name: angle_error(robot, log_of(data, run), values) for name, values in candidates.items()}
        for run in HELD_OUT
    }
    mean = {name: float(np.mean([errors[run][name] for run in HELD_OUT])) for name in candidates}
    best = min((name for name in mean if name != "madoc"), key=mean.__getitem__)
    return {
        "calibrated_to": CALIBRATED_TO,
        "unit": "rad, root mean square error of the angle after 20 control steps of 0.02 s, logged actions replayed",
        **result,
        "candidates": candidates,
        "errors": errors,
        "mean": mean,
        "best_published": best,
        "share_of_best_published": mean["madoc"] / mean[best],
    }


def calibrated(data: Path, folder: Path) -> dict:
    """The command of the documentation, on one run to calibrate to and one to judge by."""
    runs = folder / "logs"
    runs.mkdir()
    for run in (CALIBRATED_TO, HELD_OUT[0]):
        shutil.copy(log_of(data, run), runs / f"{run}.csv")
    order = pipeline.CalibrationOrder(
        task=str(PENDULUM / "pendulum.yaml"),
        source=pipeline.Source((str(runs),)),
    )
    result = pipeline.calibrate_in(folder / "run", order).to_json()
    return {name: result[name] for name in ("parameters", "verdict", "control_steps", "seconds")}


def estimate_of(result: dict) -> dict[str, float]:
    """Estimates by name."""
    return {name: found["estimate"] for name, found in result["parameters"].items()}


def published(folder: Path) -> dict[str, dict[str, float]]:
    """The makers' parameters, a set for each of their controllers, and each without its Coulomb friction.

    Not every set has that friction, and 1.3 N·m is about all that the motor gave under most controllers. Where an
    inertia is given that is not mass · length², it is that of the point mass with the same inertia and weight.
    """
    found = {}
    reader = YAML(typ="safe")
    reader.allow_duplicate_keys = True  # the makers' files set dt twice, which is not read here
    for file in sorted(folder.glob("*.yaml")):
        given = reader.load(file)
        mass, length, inertia = given["mass"], given["length"], given.get("inertia")
        if isinstance(inertia, float):
            mass, length = (mass * length) ** 2 / inertia, inertia / (mass * length)
        frictionless = {"mass": mass, "length": length, "damping": given["damping"], "friction": 0.0, "gain": 1.0}
        found[f"{file.stem}, no friction"] = frictionless
        if "coulomb_fric" in given:
            found[file.stem] = frictionless | {"friction": given["coulomb_fric"]}
    return found


def angle_error(robot: robots.Robot, log: Path, values: dict[str, float]) -> float:
    """Root mean square error of the angle, rad, after `HORIZON` control steps from every logged state."""
    simulator = simulation.make(robot.task)
    held: Dataset = logs.read(log, robot)
    states, rows = logged_states(held, simulator.task)
    starts = first_rows(held, rows, HORIZON)
    windows = windows_at(held, states[starts], rows[starts], HORIZON)
    unit = simulator.parameters.to_unit(simulator.parameters.vector(values))
    assert np.abs(unit).max() <= 1.0, f"a range of everything.yaml does not hold {values}"
    residuals = window_residuals(simulator, windows, unit[None], np.ones(2))[0]
    return float(np.sqrt(np.mean(residuals.reshape(len(windows), HORIZON, 2)[:, -1, 0] ** 2)))


def log_of(data: Path, run: str) -> Path:
    """The log under a controller."""
    return data / f"control_method_{run}" / "data_measured.csv"


if __name__ == "__main__":
    main()
