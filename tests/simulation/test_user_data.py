"""Drives and friction as numbers in a model: where a parameter writes them, and MuJoCo's own elements that say them."""

import sys

import mujoco
import numpy as np
import pytest

from madoc import robots
from madoc.errors import MadocError
from madoc.parameters import FIELDS, Parameter
from madoc.simulation import callbacks
from madoc.simulation.callbacks import DRIVE, FRICTION, dc_torque
from madoc.simulation.cpu import CpuSimulator
from madoc.simulation.mjcf import save_mjcf
from madoc.simulation.response import hidden_scales
from madoc.simulation.user_data import needs_callbacks
from madoc.simulation.write import has_gain, nominal_values, write_parameters
from own_robots import SERVO, SERVO_SPEC, write_robot

FRICTIONAL = SERVO_SPEC.replace(
    "parameters:", "friction:\n  - {joint: shaft, model: M6, up_to: 0.2}\nparameters:"
).replace("gain: 0.2,", "gain: 0.2, current_limit: 3,")
PLAIN = SERVO_SPEC.replace(', enable: "on", supply_from: volts, gain_from: p', "")
PLAIN = PLAIN.replace("conditions:\n  - {name: p, values: [2, 5]}\n", "")
OWN = [name for name in FIELDS if name.startswith(("drive_", "friction_"))]


def simulator_of(folder, spec):
    return CpuSimulator(robots.load(write_robot(folder, spec, servo=SERVO)).task, threads=1)


@pytest.mark.parametrize("field", OWN)
def test_a_parameter_is_written_to_its_number_alone(tmp_path, field):
    model = simulator_of(tmp_path, FRICTIONAL).task.compile()
    before = {name: getattr(model, name).copy() for name in ("actuator_user", "jnt_user")}
    kind, _, name = field.partition("_")
    parameter = Parameter(field, "goal" if kind == "drive" else "shaft", 0.1, 0.9)
    write_parameters(model, mujoco.MjData(model), [parameter], np.array([0.7]))
    assert nominal_values(model, parameter) == (0.7,)
    places, array = (DRIVE, "actuator_user") if kind == "drive" else (FRICTION, "jnt_user")
    changed = {places[column] for _, column in np.argwhere(getattr(model, array) != before[array])}
    assert changed == {each for each in places if each in (name, f"{name}_motor", f"{name}_external")}


@pytest.mark.parametrize(
    ("field", "element", "sentence"),
    [
        ("drive_kt", "push", "drive_kt: actuator 'push' is no such drive; say drive: of its action"),
        ("friction_load", "slide", "friction_load: joint 'slide' has no friction of this kind; say it under friction:"),
    ],
)
def test_a_number_that_is_not_there_is_refused(spring_task, field, element, sentence):
    with pytest.raises(MadocError, match=sentence):
        CpuSimulator(spring_task(Parameter(field, element, 0.1, 1.0)))


@pytest.mark.parametrize(
    ("field", "sentence"),
    [
        ("drive_current_limit", "the current of 'goal' is not limited; give it a current_limit:"),
        (
            "drive_saturation",
            "the torque of 'goal' is in proportion to its current; give it a saturation: of more than",
        ),
    ],
)
def test_a_number_that_a_drive_does_without_is_refused(tmp_path, field, sentence):
    with pytest.raises(MadocError, match=sentence):
        simulator_of(tmp_path, PLAIN.replace("drive_strength", field))


def test_without_numba_the_drive_is_refused_in_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(callbacks, "install", callbacks.install.__wrapped__)  # which has not been called yet
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(MadocError, match=r"need Numba; install it: pip install 'madoc-calibration\[drives\]'$"):
        simulator_of(tmp_path, SERVO_SPEC.replace("kt: 0.5", "kt: 0.51"))
    simulator_of(tmp_path, PLAIN.replace("kt: 0.5", "kt: 0.51"))


@pytest.mark.parametrize("means", ["position", "velocity", "duty"])
def test_a_drive_of_fixed_numbers_is_made_of_mujocos_own_elements(tmp_path, means):
    """Servo, largest force and damping together are the drive's equation, at parameters too, with no callback."""
    drive = "gain: 0.2, damping_gain: 0.05, duty_limit: 0.6" if means != "duty" else "duty_limit: 0.6"
    spec = PLAIN.replace("means: position", f"means: {means}").replace("gain: 0.2", drive)
    simulator = simulator_of(tmp_path, spec.replace("field: drive_strength", "field: drive_kt"))
    assert not needs_callbacks(simulator.task.model)
    (model,) = simulator.bind(np.array([0.8])).models
    assert not has_gain(model, 0)
    data = mujoco.MjData(model)
    numbers = {"supply": 12.0, "kt": 0.8, "resistance": 2.0, "duty_limit": 0.6, "current_limit": 1e12, "strength": 1.0}
    numbers["saturation"] = 0.0
    numbers |= {"gain": 1.0, "damping_gain": 0.0} if means == "duty" else {"gain": 0.2, "damping_gain": 0.05}
    for command, angle, rate in [(0.5, 0.1, 0.3), (1.0, -6.0, 2.0), (-0.2, 0.0, -4.0)]:
        data.qpos[:], data.qvel[:], data.ctrl[:] = angle, rate, command
        mujoco.mj_forward(model, data)
        error = command - {"position": angle, "velocity": rate, "duty": 0.0}[means]
        torque = dc_torque(error, rate, rate, **numbers)
        assert data.qfrc_actuator[0] + data.qfrc_passive[0] == pytest.approx(torque, rel=1e-12)


@pytest.mark.parametrize(("spec", "files"), [(PLAIN, ["model.xml"]), (FRICTIONAL, ["drives.py", "model.xml"])])
def test_the_export_has_python_only_where_mjcf_cannot_say_it(tmp_path, spec, files):
    simulator, folder = simulator_of(tmp_path, spec), tmp_path / "export"
    folder.mkdir()
    save_mjcf(
        simulator, simulator.parameters.to_physical(np.full(len(simulator.parameters), 0.3)), folder / "model.xml"
    )
    assert sorted(file.name for file in folder.iterdir()) == files


def test_masses_and_the_resistance_of_a_drive_can_be_scaled_without_a_trace(tmp_path):
    """Twice the mass, half the resistance, twice the friction: the same motion. A torque of known size tells."""
    simulator = simulator_of(tmp_path, FRICTIONAL)
    randomness = np.random.default_rng(0)
    states, actions = randomness.normal(size=(6, 2)), randomness.uniform(-1, 1, (6, 4))
    assert hidden_scales(simulator, simulator.parameters.middle, states, actions) == (True, False)
