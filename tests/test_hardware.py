"""Machines of hardware, where their logs are: in folders that variables name, or in shared/data beside the repository.
They are not Madoc's to copy."""

import importlib.util
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from madoc import robots

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
STIFFNESS = 13.0
"""N·m/rad, of the arm's servo that lifts its shoulder."""


def logs_of(variable, name):
    """The folder of a machine's logs."""
    place = Path(os.environ.get(variable, ROOT.parent / "shared" / "data" / name))
    if not place.is_dir():
        pytest.skip(f"logs are not here; name their folder in {variable}")
    return place


def benchmark_of(name):
    """The module benchmarks/NAME.py."""
    place = ROOT / "benchmarks" / f"{name}.py"
    sys.path.insert(0, str(place.parent))
    try:
        spec = importlib.util.spec_from_file_location(name, place)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(place.parent))
    return module


@pytest.fixture(scope="module")
def pendulum():
    return benchmark_of("real_pendulum").compare(logs_of("MADOC_PENDULUM", "dfki_simple_pendulum"))


@pytest.fixture(scope="module")
def arm():
    return benchmark_of("real_arm").compare(logs_of("MADOC_SO101", "so101"))


@pytest.fixture(scope="module")
def xl330():
    return logs_of("MADOC_XL330", "xl330") / "logs"


@pytest.fixture(scope="module")
def servo():
    return benchmark_of("real_servo")


@pytest.mark.timeout(600)  # five minutes with nothing beside it
def test_the_arm_is_predicted_better_than_by_the_published_model_and_at_mid_range(arm):
    for motion, errors in arm["errors"].items():
        assert errors["madoc"] < 0.55 * errors["published"], motion
        assert errors["madoc"] < 0.85 * errors["mid-range"], motion
    assert arm["verdict"]["word"] == "USABLE"
    low, high = arm["parameters"]["actuator_gain.Pitch_command"]["interval"]
    assert low < STIFFNESS < high


def test_the_run_of_the_pendulum_held_out_is_predicted(pendulum):
    assert pendulum["verdict"]["word"] == "USABLE"
    assert pendulum["errors"]["ddp"]["madoc"] < 0.06


def test_no_published_parameters_predict_the_pendulum_better(pendulum):
    for run, errors in pendulum["errors"].items():
        assert errors["madoc"] <= min(errors.values()), run


def test_the_length_of_the_pendulum_is_that_of_the_rod(pendulum):
    low, high = pendulum["parameters"]["length"]["interval"]
    assert low < 0.5 < high


def integrated(log, gain, values):
    """The angle by the published equations, in steps of 1 ms from rest, with the logged supply: no MuJoCo."""
    rows = np.genfromtxt(log, delimiter=",", names=True)
    grid = np.arange(rows["time"][0], rows["time"][-1], 0.001)
    last = np.searchsorted(rows["time"], grid + 1e-9) - 1
    of = {name: 0.0 for name in ("stribeck", "load_motor", "load_external", "stribeck_load_motor")} | {
        "stribeck_load_external": 0.0,
        "stribeck_speed": 1.0,
        "stribeck_exponent": 1.0,
        "quadratic_motor": 0.0,
        "quadratic_external": 0.0,
    }
    of |= values
    angle, speed, inertia, found = rows["position"][0], 0.0, 0.49 * 0.1**2 + of["armature"], []
    for goal, volts, on in zip(rows["goal"][last], rows["volts"][last], rows["torque_enable"][last], strict=True):
        found.append(angle)
        external = -0.49 * 9.81 * 0.1 * np.sin(angle - of["zero"])
        duty = np.clip(gain * 0.0028774 * (goal - angle), -1, 1)
        motor = on * of["kt"] * (duty * volts - of["kt"] * speed) / of["resistance"]
        at_rest = of["stribeck"] + abs(of["stribeck_load_external"] * external - of["stribeck_load_motor"] * motor)
        if motor * external < 0:
            drives = abs(external) < abs(motor)
            at_rest += of["quadratic_external"] * external**2 if drives else of["quadratic_motor"] * motor**2
        most = of["coulomb"] + abs(of["load_external"] * external - of["load_motor"] * motor)
        most += at_rest * np.exp(-(abs(speed / of["stribeck_speed"]) ** of["stribeck_exponent"]))
        most += of["viscous"] * abs(speed)
        stopping = inertia / 0.001 * speed + motor + external
        speed += 0.001 / inertia * (motor + external - np.sign(stopping) * min(abs(stopping), most))
        angle += 0.001 * speed
    return grid, np.array(found)


@pytest.mark.parametrize("model", ["M1", "M6"])
def test_the_published_models_of_the_servo_move_as_their_equations_do(servo, xl330, tmp_path, model):
    robot = robots.load(servo.written(tmp_path, model, servo.PUBLISHED[model]))
    log = xl330 / "gain200_sin_time_square.csv"
    _, whole = servo.errors_of(robot, {}, [log])[log.stem]
    grid, angle = integrated(log, 200, servo.PUBLISHED[model])
    rows = np.genfromtxt(log, delimiter=",", names=True)
    error = np.sqrt(np.mean((angle - np.interp(grid, rows["time"], rows["position"])) ** 2))
    assert whole == pytest.approx(error, rel=0.1)


def test_the_servo_at_a_gain_that_was_never_shown_is_predicted_better_than_by_the_published_models(servo, xl330):
    found = servo.compare(xl330, 400, "M5", ("horizon=200", "loss=linear"))
    of_each = {name: np.mean(list(errors.values()), axis=0) for name, errors in found["errors"].items()}
    assert (of_each["madoc"] < 0.7 * of_each["published M6"]).all()
