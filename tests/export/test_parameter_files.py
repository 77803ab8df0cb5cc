"""Files of parameters: patches, ranges, those of mujoco.sysid, and drives as BAM reads them."""

import json
import math

import mujoco
import numpy as np
import pytest
from ruamel.yaml import YAML

from madoc import robots
from madoc.calibration import ParameterEstimate
from madoc.export.parameter_files import (
    Exported,
    bam_files,
    save_bam,
    save_patch,
    save_randomization,
    save_sysid_parameters,
)
from madoc.parameters import Parameter
from madoc.simulation import make
from madoc.simulation.configuration import JointDrive, joint_drives
from madoc.simulation.mjcf import Change
from own_robots import SERVO, SERVO_SPEC, write_robot

read_yaml = YAML(typ="safe").load
PROVENANCE = dict(
    run="h0",
    method="least-squares",
    seed=0,
    data={"rows": 10, "fingerprint": "0a"},
    versions={"mujoco": "3.17.0"},
    verdict={"word": "CALIBRATED", "sentence": "it is"},
    warnings=[],
)


def found():
    """A mass with an interval, a damping that two joints share, a delay."""
    return [
        Exported(Parameter("body_mass", "cart", 1, 3), ParameterEstimate(2.5, 0.1, 1, 3, "kg", [2.4, 3.2]), (2.0,)),
        Exported(
            Parameter("dof_damping", ("left", "right"), 0, 2, label="knees"),
            ParameterEstimate(0.5, 0.5, 0, 2, "N·m·s/rad"),
            (0.4, 0.6),
        ),
        Exported(Parameter("action_delay", "", 0, 0.04), ParameterEstimate(0.01, 0.0, 0, 0.04, "s"), (0.0,)),
    ]


def test_a_patch_says_what_changed_and_where_it_comes_from(tmp_path):
    changes = [Change("inertial of body cart", "mass", [2.0], [2.5])]
    save_patch(tmp_path / "p.yaml", found(), PROVENANCE, changes=changes, stepping={"control_step_s": 0.02})
    patch = read_yaml((tmp_path / "p.yaml").read_text())
    assert patch["provenance"]["data"] == {"rows": 10, "fingerprint": "0a"}
    assert patch["provenance"]["verdict"]["word"] == "CALIBRATED" and "warnings" not in patch["provenance"]
    assert patch["model_changes"] == [{"element": "inertial of body cart", "attribute": "mass", "old": 2.0, "new": 2.5}]
    mass, damping, delay = patch["parameters"]
    assert mass == {
        "parameter": "body_mass.cart",
        "field": "body_mass",
        "element": "cart",
        "old": 2.0,
        "new": 2.5,
        "unit": "kg",
        "std": 0.1,
        "interval_95": [2.4, 3.2],
        "searched": [1, 3],
    }
    assert (damping["parameter"], damping["element"], damping["old"]) == ("knees", ["left", "right"], [0.4, 0.6])
    assert "element" not in delay and delay["applied"] == "around the model, which has no place for it"


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("body_mass.cart", 2.4, 3.0), ("knees", 0.0, 0.5 + 1.959963984540054 * 0.5), ("action_delay", 0.01, 0.01)],
)
def test_ranges_are_the_intervals_within_what_was_searched(tmp_path, name, low, high):
    save_randomization(tmp_path / "r.yaml", found(), PROVENANCE, None)
    row = read_yaml((tmp_path / "r.yaml").read_text())["parameters"][name]
    assert (row["low"], row["high"]) == (low, high) and row["low"] <= row["mean"] <= row["high"]
    stds = {"body_mass.cart": 0.7 / 1.959963984540054, "knees": 0.5, "action_delay": 0.0}  # of the wider half
    assert row["std"] == pytest.approx(stds[name])


def test_a_covariance_goes_along_with_its_order(tmp_path):
    rows = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    save_randomization(tmp_path / "r.yaml", found(), PROVENANCE, rows)
    covariance = read_yaml((tmp_path / "r.yaml").read_text())["covariance"]
    assert covariance == {"order": ["body_mass.cart", "knees", "action_delay"], "rows": rows}


def test_parameters_for_sysid_have_its_six_fields(tmp_path):
    save_sysid_parameters(tmp_path / "s.yaml", found())
    rows = read_yaml((tmp_path / "s.yaml").read_text())
    assert rows["knees"] == {
        "name": "knees",
        "nominal": [0.5],
        "min_value": [0.0],
        "max_value": [2.0],
        "value": [0.5],
        "frozen": False,
    }


def test_mujocos_own_toolbox_reads_them(tmp_path):
    parameter = pytest.importorskip("mujoco.sysid._src.parameter", reason="mujoco[sysid] is not installed")
    save_sysid_parameters(tmp_path / "s.yaml", found())
    read = parameter.ParameterDict.load_from_disk(tmp_path / "s.yaml")
    assert read.as_vector().tolist() == [2.5, 0.5, 0.01]
    assert [ends.tolist() for ends in read.get_bounds()] == [[1.0, 0.0, 0.0], [3.0, 2.0, 0.04]]


FALLING = "coulomb: 0.05, viscous: 0.1, stribeck: 0.2, stribeck_speed: 0.5, stribeck_exponent: 1.5"
APART = "load_motor: 0.27, load_external: 0.1, stribeck_load_motor: 0.02, stribeck_load_external: 0.08"
M6 = f"{{joint: shaft, model: M6, {FALLING}, {APART}, quadratic_motor: 0.01, quadratic_external: 0.005}}"
M4 = f"{{joint: shaft, model: M4, {FALLING}, load: 0.3, stribeck_load: 0.1}}"
M1 = "{joint: shaft, model: M1, coulomb: 0.05, viscous: 0.1}"
PLAIN = SERVO_SPEC.replace(', enable: "on", supply_from: volts, gain_from: p', ", duty_limit: 0.9")
PLAIN = PLAIN.replace("conditions:\n  - {name: p, values: [2, 5]}\n", "")


def exported(folder, spec, friction=M1, strength=0.8, delay=0.0):
    """The calibrated model of a spec, and the file of its one drive."""
    spec = spec.replace("parameters:", f"friction:\n  - {friction}\nparameters:")
    simulator = make(robots.load(write_robot(folder, spec, servo=SERVO)).task, threads=1)
    model = simulator.model(np.array([strength]))
    (drive,) = joint_drives(model, {"p": 2.0, "volts": 12.0, "on": 1.0})
    (path,) = bam_files(folder, [drive])
    save_bam(path, drive, delay)
    return model, json.loads(path.read_text())


def bam_torque(of, target, angle, speed):
    """The motor's torque by BAM's bam/actuator.py, for the numbers of a file."""
    duty = (target - angle) * of["kp"] * of["error_gain"]
    if of["max_current"] is not None:
        middle, span = of["kt"] * speed / of["vin"], of["R"] * of["max_current"] / of["vin"]
        duty = min(max(duty, middle - span), middle + span)
    volts = of["vin"] * min(max(duty, -of["max_pwm"]), of["max_pwm"])
    return of["kt"] * volts / of["R"] - of["kt"] ** 2 * speed / of["R"]


def bam_friction(of, motor, external, speed):
    """The largest dry friction by BAM's bam/model.py, for the numbers of a file."""
    limit = of["friction_base"]
    if of["model"] == "m6":
        at_rest = math.exp(-(abs(speed / of["dtheta_stribeck"]) ** of["alpha"]))
        limit += abs(external * of["load_friction_external"] - motor * of["load_friction_motor"])
        limit += at_rest * of["friction_stribeck"]
        limit += at_rest * abs(
            external * of["load_friction_external_stribeck"] - motor * of["load_friction_motor_stribeck"]
        )
        if np.sign(external) != np.sign(motor):
            if abs(external) < abs(motor):
                limit += at_rest * of["load_friction_external_quad"] * external**2
            if abs(external) > abs(motor):
                limit += at_rest * of["load_friction_motor_quad"] * motor**2
    return limit


def test_the_numbers_by_hand(tmp_path):
    """A strength of 0.8 is 2 Ω / 0.8 = 2.5 Ω and 0.8 · 3 A = 2.4 A; the firmware's gain is the first condition."""
    _, found = exported(tmp_path, SERVO_SPEC.replace("gain: 0.2,", "gain: 0.2, current_limit: 3,"), M6, delay=0.005)
    said = found.pop("not_the_same_here")
    assert found == {
        "model": "m6",
        "actuator": "mx64",
        "kt": 0.5,
        "R": 2.5,
        "armature": 0.0,
        "q_offset": 0.0,
        "command_delay": 0.005,
        "friction_base": 0.05,
        "friction_viscous": 0.1,
        "friction_stribeck": 0.2,
        "dtheta_stribeck": 0.5,
        "alpha": 1.5,
        "load_friction_motor": 0.27,
        "load_friction_external": 0.1,
        "load_friction_motor_stribeck": 0.02,
        "load_friction_external_stribeck": 0.08,
        "load_friction_motor_quad": 0.01,
        "load_friction_external_quad": 0.005,
        "vin": 12.0,
        "kp": 2.0,
        "error_gain": 0.2,
        "max_pwm": 1.0,
        "max_current": pytest.approx(2.4),
    }
    assert said == [
        "vin is the supply of the spec, and the log's volts varies; 1 V is 0.2 N·m at standstill",
        "versions of BAM without command_delay leave 5 ms of delay out",
        "friction by load counts contacts as load, and leaves springs out",
    ]


@pytest.mark.parametrize("friction", [M1, M4, M6])
@pytest.mark.parametrize("spec", [PLAIN, PLAIN.replace("gain: 0.2,", "gain: 0.2, current_limit: 1.5,")])
@pytest.mark.parametrize(
    ("target", "angle", "speed"),
    [(0.3, 0.1, 0.2), (1.0, -2.0, 0.0), (-0.5, 0.4, -1.5), (0.2, 1.2, 0.4), (0.0, 0.1, 3.0)],
)
def test_bams_equations_on_the_file_give_what_mujoco_computes(tmp_path, friction, spec, target, angle, speed):
    model, found = exported(tmp_path, spec, friction)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[0] = angle, speed, target
    mujoco.mj_forward(model, data)
    motor = bam_torque(found, target, angle, speed)
    damping = found["friction_viscous"] * speed  # of the joint; of MuJoCo's own elements back-EMF is damping too
    assert data.qfrc_actuator[0] + data.qfrc_passive[0] + damping == pytest.approx(motor, rel=1e-12)
    external = -9.81 * math.sin(angle)  # of 1 kg at 1 m, hanging
    assert data.qfrc_bias[0] == pytest.approx(-external)
    assert data.efc_frictionloss[0] == pytest.approx(bam_friction(found, motor, external, speed), rel=1e-9)


@pytest.mark.parametrize("friction", [M1, M6])
def test_bam_itself_reads_the_file(tmp_path, friction):
    bam = pytest.importorskip("bam.model", reason="better-actuator-models is not installed")
    _, found = exported(tmp_path, PLAIN, friction)
    model = bam.load_model(str(tmp_path / "bam-goal.json"))
    for name in ("vin", "kp", "error_gain", "max_pwm", "max_current"):
        setattr(model.actuator, name, found[name])
    for target, angle, speed, external in [(0.3, 0.1, 0.2, -1.0), (-0.5, 0.4, -1.5, 2.0), (1.0, -2.0, 0.0, 0.3)]:
        motor = model.actuator.compute_torque(
            model.actuator.compute_control(target, angle, speed, 0.01), True, angle, speed
        )
        assert motor == pytest.approx(bam_torque(found, target, angle, speed))
        friction, damping = model.compute_frictions(motor, external, speed)
        assert (friction, damping) == pytest.approx((bam_friction(found, motor, external, speed), 0.1))


def drive(**changed):
    numbers = {"supply": 12.0, "kt": 0.5, "resistance": 2.0, "gain": 0.2, "damping_gain": 0.0, "duty_limit": 1.0}
    numbers |= {"strength": 1.0, "saturation": 0.0}
    plain = dict(name="a b", means="position", numbers=numbers, current_limit=None, setting=1.0, supply_from="")
    return JointDrive(**plain | dict(friction={}, coulomb=0.0, viscous=0.0, drag=0.0, armature=0.0, zero=0.0) | changed)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({}, []),
        ({"means": "duty"}, ["the command is a duty and BAM's is a position, so error_gain is 0"]),
        ({"gives": True}, ["backlash and elasticity of the gear are left out"]),
        ({"drag": 0.01}, ["drag is left out, 5.76 N·m at the no-load speed of 24 rad/s"]),
        (
            {"numbers": drive().numbers | {"damping_gain": 0.1}},
            ["the firmware brakes by 0.3 N·m·s/rad, and BAM's loop does not"],
        ),
        (
            {"numbers": drive().numbers | {"saturation": 0.1}},  # 6 A: 3 N·m over 1.6
            ["saturation is left out, which at standstill and the largest current leaves 1.88 of 3 N·m"],
        ),
    ],
)
def test_what_bam_cannot_say_is_said_with_its_size(tmp_path, changed, said):
    save_bam(tmp_path / "b.json", drive(**changed), 0.0)
    assert json.loads((tmp_path / "b.json").read_text())["not_the_same_here"] == said


def test_drives_whose_names_are_alike_have_files_of_their_own(tmp_path):
    assert [path.name for path in bam_files(tmp_path, [drive(), drive(name="a_b")])] == [
        "bam-a_b-0.json",
        "bam-a_b-1.json",
    ]
