"""Drives, friction and gears in a model: numbers of user data, elements of MuJoCo's own, and what a gear inserts."""

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
from madoc.simulation.joints import (
    deflection_values,
    deflections,
    loaded_deflections,
    longest_timestep,
    needs_callbacks,
)
from madoc.simulation.mjcf import save_mjcf
from madoc.simulation.response import hidden_scales
from madoc.simulation.write import has_gain, nominal_values, single_joints, write_parameters
from own_robots import GEARED, GEARED_SPEC, SERVO, SERVO_SPEC, write_robot

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


LINK = GEARED_SPEC.replace("encoder: motor", "encoder: link")


def geared_simulator(folder, spec=GEARED_SPEC, model=GEARED):
    return CpuSimulator(robots.load(write_robot(folder, spec, geared=model)).task, threads=1)


@pytest.mark.parametrize(
    ("deflection", "rate", "torque"),
    [
        (0.005, 0.0, 0.0),  # within the play of 0.01 to either side
        (0.03, 0.0, -2.0),  # 0.02 rad beyond it, 100 N·m/rad
        (-0.03, 0.1, 1.95),  # and 0.5 N·m·s/rad
        (0.0, 0.1, -0.05),
    ],
)
def test_a_gear_is_a_spring_with_a_dead_band_and_a_damper(tmp_path, deflection, rate, torque):
    model = geared_simulator(tmp_path).task.model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (0.2, deflection), (0.3, rate)
    mujoco.mj_forward(model, data)
    assert data.qfrc_passive[1] == pytest.approx(torque, rel=1e-12)
    assert data.qfrc_passive[0] == pytest.approx(-(0.5**2) / 2.0 * 0.3, rel=1e-12)  # back-EMF, kt² / R


def test_motor_and_link_swing_against_each_other(tmp_path):
    """Inertias of 0.02 and 0.01 kg·m², and nothing from outside: ω² = 100 · (1 / 0.02 + 1 / 0.01)."""
    spec = GEARED_SPEC.replace("backlash: 0.02", "backlash: 0").replace("damping: 0.5", "damping: 0")
    spec = spec.replace("means: position", "means: duty").replace(", gain: 5", "").replace("kt: 0.5", "kt: 1e-9")
    still = GEARED.replace('timestep="0.001"', 'timestep="0.0001" gravity="0 0 0"').replace(
        "1e-6 1e-6 1e-6", "1e-9 1e-9 1e-9"
    )
    simulator = geared_simulator(tmp_path, spec, still)
    system = simulator.bind({"gear_backlash.shaft": 0.0, "gear_stiffness.shaft": 100.0, "gear_damping.shaft": 0.0})
    state = np.array([0.0, 0.001, 0.0, 0.0])
    after = system.roll_out(state[None, None], np.zeros((1, 1, 30, 1)))[0, 0]
    frequency, time = np.sqrt(100.0 * (1 / 0.02 + 1 / 0.01)), 0.01 * np.arange(1, 31)
    np.testing.assert_allclose(after[:, 1], 0.001 * np.cos(frequency * time), atol=1e-5)
    np.testing.assert_allclose(0.02 * after[:, 2] + 0.01 * after[:, 2:].sum(1), 0.0, atol=1e-9)
    assert longest_timestep(simulator.task.model, 0, 100.0, 0.0) == pytest.approx(1.0 / frequency, rel=1e-3)
    assert longest_timestep(simulator.task.model, 0, 100.0, 10.0) == pytest.approx(1.0 / (10.0 * 150.0), rel=1e-3)


@pytest.mark.parametrize(
    ("field", "array", "numbers"),
    [
        ("gear_backlash", "tendon_lengthspring", [-0.015, 0.015]),
        ("gear_stiffness", "tendon_stiffness", 0.03),
        ("gear_damping", "tendon_damping", 0.03),
    ],
)
def test_a_parameter_is_written_to_the_tendon_of_its_gear(tmp_path, field, array, numbers):
    model, parameter = geared_simulator(tmp_path).task.compile(), Parameter(field, "shaft", 0.0, 1.0)
    assert nominal_values(model, parameter) == {"gear_backlash": (0.02,), "gear_stiffness": (100.0,)}.get(field, (0.5,))
    write_parameters(model, mujoco.MjData(model), [parameter], np.array([0.03]))
    np.testing.assert_allclose(getattr(model, array)[0], numbers, rtol=1e-15)
    with pytest.raises(MadocError, match=f"{field}: joint 'shaft_gear' has no gear; say it under gears:"):
        nominal_values(model, Parameter(field, "shaft_gear", 0.0, 1.0))


def test_a_deflection_is_no_joint_of_the_robot(tmp_path):
    model = geared_simulator(tmp_path).task.model
    assert deflections(model).tolist() == [1]
    assert [each.tolist() for each in deflection_values(model)] == [[1], [3]]
    assert [joint.name for joint, _ in single_joints(model)] == ["shaft"]


def test_the_teeth_touch_where_the_load_presses_them(tmp_path):
    """A rod that is level, so that 1 kg at 0.1 m turns it back by 0.981 N·m, is at rest behind its gear."""
    model = geared_simulator(tmp_path).task.model
    for level in (-np.pi / 2.0, np.pi / 2.0):
        states = np.array([[level, 0.0, 0.0, 0.0]])
        (deflection,) = loaded_deflections(model, states, np.zeros((1, 2)))[0]
        assert deflection == pytest.approx(-np.sign(level) * (0.01 + 9.81 * 0.1 / 100.0), rel=1e-9)
        data = mujoco.MjData(model)
        data.qpos[:] = level - deflection, deflection
        mujoco.mj_forward(model, data)
        assert data.qfrc_passive[1] - data.qfrc_bias[1] == pytest.approx(0.0, abs=1e-9)
    turning = loaded_deflections(model, np.zeros((1, 4)), np.array([[50.0, 0.0]]))[0, 0]
    assert turning == pytest.approx(-(0.01 + 50.0 * 0.010001 / 100.0), rel=1e-9)  # the link lags behind its motor


@pytest.mark.parametrize(("spec", "seen"), [(GEARED_SPEC, 0.1), (LINK, 0.13)])
def test_signals_and_the_loop_of_a_drive_read_the_encoder(tmp_path, spec, seen):
    """A duty of 5 · (goal - angle) - 0.2 · rate, of 12 V, makes 0.25 N·m/V; back-EMF is that of the motor's speed."""
    pytest.importorskip("numba")
    spec = spec.replace("gain: 5", "gain: 5, damping_gain: 0.2").replace(
        "position(shaft)}", "position(shaft)}\n  - {name: rate, reads: velocity(shaft)}"
    )
    simulator = geared_simulator(tmp_path, spec)
    system, state = simulator.bind(simulator.parameters.middle), np.array([[[0.1, 0.03, 0.2, 0.06]]])
    rate = {0.1: 0.2, 0.13: 0.26}[seen]
    np.testing.assert_allclose(system.observe(state)[0, 0], [seen, rate], rtol=1e-12)
    force = system.actuator_forces(state, np.full((1, 1, 1), 0.2))[0, 0, 0, 0]
    back_emf = 0.5 * 0.2 if seen == 0.13 else 0.0  # of own elements it is damping of the actuator
    assert force == pytest.approx(0.25 * (12.0 * (5.0 * (0.2 - seen) - 0.2 * rate) - back_emf), rel=1e-9)


@pytest.mark.parametrize(("spec", "files"), [(GEARED_SPEC, ["model.xml"]), (LINK, ["drives.py", "model.xml"])])
def test_the_export_of_a_gear_is_plain_mjcf(tmp_path, spec, files):
    if len(files) > 1:
        pytest.importorskip("numba")
    simulator, folder = geared_simulator(tmp_path, spec), tmp_path / "export"
    folder.mkdir()
    changes = save_mjcf(simulator, np.array([0.03, 150.0, 0.2]), folder / "model.xml")
    assert sorted(file.name for file in folder.iterdir()) == files
    assert {change.attribute for change in changes} == {"springlength", "stiffness", "damping"}
