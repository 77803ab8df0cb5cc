"""Gears: the torque that they carry, how they swing, where a parameter is written, what encoders and exports have."""

import mujoco
import numpy as np
import pytest

from madoc import robots
from madoc.errors import MadocError
from madoc.parameters import Parameter
from madoc.simulation.cpu import CpuSimulator
from madoc.simulation.gears import deflection_values, deflections, loaded_deflections, longest_timestep
from madoc.simulation.mjcf import save_mjcf
from madoc.simulation.write import nominal_values, single_joints, write_parameters
from own_robots import GEARED, GEARED_SPEC, write_robot

LINK = GEARED_SPEC.replace("encoder: motor", "encoder: link")


def simulator_of(folder, spec=GEARED_SPEC, model=GEARED):
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
    model = simulator_of(tmp_path).task.model
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
    simulator = simulator_of(tmp_path, spec, still)
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
    model, parameter = simulator_of(tmp_path).task.compile(), Parameter(field, "shaft", 0.0, 1.0)
    assert nominal_values(model, parameter) == {"gear_backlash": (0.02,), "gear_stiffness": (100.0,)}.get(field, (0.5,))
    write_parameters(model, mujoco.MjData(model), [parameter], np.array([0.03]))
    np.testing.assert_allclose(getattr(model, array)[0], numbers, rtol=1e-15)
    with pytest.raises(MadocError, match=f"{field}: joint 'shaft_gear' has no gear; say it under gears:"):
        nominal_values(model, Parameter(field, "shaft_gear", 0.0, 1.0))


def test_a_deflection_is_no_joint_of_the_robot(tmp_path):
    model = simulator_of(tmp_path).task.model
    assert deflections(model).tolist() == [1]
    assert [each.tolist() for each in deflection_values(model)] == [[1], [3]]
    assert [joint.name for joint, _ in single_joints(model)] == ["shaft"]


def test_the_teeth_touch_where_the_load_presses_them(tmp_path):
    """A rod that is level, so that 1 kg at 0.1 m turns it back by 0.981 N·m, is at rest behind its gear."""
    model = simulator_of(tmp_path).task.model
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
    simulator = simulator_of(tmp_path, spec)
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
    simulator, folder = simulator_of(tmp_path, spec), tmp_path / "export"
    folder.mkdir()
    changes = save_mjcf(simulator, np.array([0.03, 150.0, 0.2]), folder / "model.xml")
    assert sorted(file.name for file in folder.iterdir()) == files
    assert {change.attribute for change in changes} == {"springlength", "stiffness", "damping"}
