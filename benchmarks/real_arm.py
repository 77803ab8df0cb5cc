"""An SO-101 arm of hardware: how well its motions are predicted by what Madoc finds, and by the published model.

    python benchmarks/real_arm.py --data FOLDER

FOLDER holds `logs/*.csv` and `model/`, as docs/real-arm.md says where from. Calibrated to eleven motions; of the two
others the commands are replayed from the measured state over windows of one second. The published model is replayed as
it is, with its own actuators and time step.
"""

import argparse
import json
import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from kept import RESULTS, Study
from ruamel.yaml import YAML

from madoc import pipeline, robots, simulation
from madoc.data import Dataset, logs

ROOT = Path(__file__).parent
STUDY = Study(RESULTS / "real_arm.jsonl", ())
"""One row for each time that it was run."""
ARM = ROOT.parent / "examples" / "so101" / "so101.yaml"
HELD_OUT = ("pick_place", "random_waypoints")
PUBLISHED_MODEL = "so101_new_calib.xml"
WINDOW, APART = 50, 25
"""Length of a replayed window and distance of two windows, in control steps of 0.02 s."""
BUDGET = "600s"
"""Of each calibration; two idle cores need a part of it."""
SLOPE = 3
"""Rows before and after the first of a window over which the velocity there is measured."""
THIRDS = (
    ("actuator_bandwidth", "friction_gravity", "multisine", "gripper_cycles"),
    ("backlash_detection", "chirp_sweep", "prbs_excitation", "ramp_motion"),
    ("center_workspace", "hold_under_gravity", "inertia_coupling"),
)
"""The motions calibrated to, dealt out so that each third has fast and slow ones."""
PUBLISHED = "zero"
"""The parameter that a spec of the published model has to have."""
_ACTUATORS = re.compile(r"<actuator>.*</actuator>", re.DOTALL)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--thirds", action="store_true", help="calibrate to each third of the motions as well")
    arguments = parser.parse_args()
    found = compare(arguments.data, thirds=arguments.thirds)
    STUDY.add(found)
    print(json.dumps(found, indent=1))


def compare(data: Path, *, thirds: bool = False) -> dict:
    """Estimates and verdict, the errors of every replay, and where the thirds of the motions disagree."""
    motions = [log.stem for log in sorted((data / "logs").glob("*.csv")) if log.stem not in HELD_OUT]
    with tempfile.TemporaryDirectory() as folder:
        spec = beside_model(data, Path(folder))
        result = calibrated(spec, data, motions, Path(folder) / "all")
        errors = errors_of(spec, data, estimates_of(result))
        parts = [calibrated(spec, data, motions, Path(folder) / motions[0]) for motions in THIRDS if thirds]
    return {
        "calibrated_to": motions,
        "unit": "rad, root mean square error of all joint angles over windows of 1 s, commands replayed",
        **result,
        "errors": errors,
        "share_of_published": {motion: row["madoc"] / row["published"] for motion, row in errors.items()},
        "thirds": [part["parameters"] for part in parts],
        "thirds_disagree": disagreeing([part["parameters"] for part in parts]),
    }


def beside_model(data: Path, folder: Path) -> Path:
    """The spec of the example in a folder that has the published model."""
    shutil.copytree(data / "model", folder / "model")
    own = (folder / "model" / PUBLISHED_MODEL).read_text()
    (folder / "model" / "so101.xml").write_text(_ACTUATORS.sub("", own))
    return Path(shutil.copy(ARM, folder))


def calibrated(spec: Path, data: Path, motions: Sequence[str], folder: Path) -> dict:
    """The command of the documentation, on some of the motions."""
    runs = folder / "logs"
    runs.mkdir(parents=True)
    for motion in motions:
        shutil.copy(data / "logs" / f"{motion}.csv", runs)
    order = pipeline.CalibrationOrder(
        task=str(spec),
        source=pipeline.Source((str(runs),)),
        search=pipeline.Search(method="least-squares", budget=BUDGET),
        holdout=0.2,
    )
    result = pipeline.calibrate_in(folder / "run", order).to_json()
    kept = ("status", "parameters", "verdict", "warnings", "control_steps", "seconds")
    return {name: result[name] for name in kept if name in result}


def estimates_of(result: dict) -> dict[str, float]:
    """Estimates by name."""
    return {name: found["estimate"] for name, found in result["parameters"].items()}


def errors_of(spec: Path, data: Path, estimates: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """Errors by motion held out, of what was found, of the published model, and of mid-range."""
    ours = robots.load(spec)
    middle = dict(zip(ours.task.parameters.names, ours.task.parameters.middle.tolist(), strict=True))
    candidates = {
        "madoc": (ours, estimates),
        "published": (as_published(spec), {PUBLISHED: 0.0}),
        "mid-range": (ours, middle),
    }
    return {
        motion: {
            name: replay_error(*candidate, data / "logs" / f"{motion}.csv") for name, candidate in candidates.items()
        }
        for motion in HELD_OUT
    }


def as_published(spec: Path) -> robots.Robot:
    """The published model with its own actuators and time step; its one parameter, a joint's zero, is left at 0."""
    document = YAML(typ="safe").load(spec)
    document["model"] = f"model/{PUBLISHED_MODEL}"
    del document["timestep"]
    document["actions"] = [{"name": row["name"], "actuator": row["joint"]} for row in document["actions"]]
    document["parameters"] = [{"field": "jnt_ref", "element": "gripper", "name": PUBLISHED, "low": -1.0, "high": 1.0}]
    place = spec.with_name("published.yaml")
    YAML(typ="safe").dump(document, place)
    return robots.load(place)


def replay_error(robot: robots.Robot, values: Mapping[str, float], log: Path) -> float:
    """Root mean square error of all joint angles, rad, over windows that begin at the measured state."""
    simulator = simulation.make(robot.task)
    dataset: Dataset = logs.read(log, robot)
    seen = np.asarray(dataset.transitions.observation, np.float64)
    action = np.asarray(dataset.transitions.action, np.float64)
    rows = np.arange(SLOPE, len(seen) - WINDOW - 1, APART)
    speed = (seen[rows + SLOPE] - seen[rows - SLOPE]) / (2 * SLOPE * simulator.control_step)
    state = np.concatenate([seen[rows], speed], axis=-1)[None]
    system, following = simulator.bind(dict(values)), rows[:, None] + np.arange(WINDOW)
    states = system.roll_out(state, action[following][None])[0]
    replayed = system.observe(states.reshape(1, -1, states.shape[-1]))[0].reshape(*following.shape, -1)
    return float(np.sqrt(np.mean((replayed - seen[following + 1]) ** 2)))


def disagreeing(thirds: list[dict]) -> list[str]:
    """Parameters whose 95 % intervals of two thirds do not meet."""
    names = []
    for name in thirds[0] if thirds else ():
        intervals = [third[name]["interval"] for third in thirds]
        if max(low for low, _ in intervals) > min(high for _, high in intervals):
            names.append(name)
    return names


if __name__ == "__main__":
    main()
