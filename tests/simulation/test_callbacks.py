"""Drives and friction that MuJoCo's elements cannot say: their equations by hand, and inside MuJoCo's own steps."""

import math
import shutil
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from madoc import robots
from madoc.simulation import callbacks
from madoc.simulation.callbacks import DRIVE, FRICTION, MARK, MEANS, UNLIMITED, dc_torque, friction_limit
from madoc.simulation.cpu import CpuSimulator
from own_robots import SERVO, SERVO_SPEC, write_robot

DC = {"supply": 10.0, "kt": 0.5, "resistance": 2.0, "gain": 0.4, "damping_gain": 0.0, "duty_limit": 1.0}
DC |= {"current_limit": UNLIMITED, "strength": 1.0, "saturation": 0.0}
NONE = dict.fromkeys(FRICTION[1:], 0.0) | {"stribeck_speed": 2.0, "stribeck_exponent": 1.0}


@pytest.mark.parametrize(
    ("change", "error", "speed", "torque"),
    [
        ({}, 0.5, 0.0, 0.5),  # duty 0.2, 2 V, 1 A
        ({}, 0.5, 2.0, 0.25),  # back-EMF of 1 V leaves 0.5 A
        ({}, 9.0, 0.0, 2.5),  # duty 1: 10 V, 5 A
        ({}, -9.0, 0.0, -2.5),
        ({}, 9.0, 20.0, 0.0),  # no torque at the speed without load
        ({}, 0.0, 4.0, -0.5),  # the shorted motor brakes
        ({"damping_gain": 0.1}, 0.5, 1.0, 0.125),  # duty 0.2 - 0.1, 1 V less 0.5 V
        ({"duty_limit": 0.3}, 9.0, 0.0, 0.75),
        ({"current_limit": 2.0}, 9.0, 0.0, 1.0),
        ({"strength": 0.8}, 0.5, 0.0, 0.4),
        ({"saturation": 0.2}, 9.0, 0.0, 1.25),  # 5 A are 1/saturation: half of 2.5
        ({"saturation": 0.2}, 0.0, 4.0, -0.5 / 1.2),  # 1 A
        ({"saturation": 0.2, "current_limit": 2.0}, 9.0, 0.0, 1.0 / 1.4),
        ({"supply": 5.0}, 0.5, 0.0, 0.25),
    ],
)
def test_the_torque_of_a_dc_drive(change, error, speed, torque):
    assert dc_torque(error, speed, speed, **(DC | change)) == pytest.approx(torque, rel=1e-14)


@pytest.mark.parametrize(
    ("terms", "motor", "external", "limit"),
    [
        ({}, 3.0, -2.0, 0.1),  # M1
        ({"stribeck": 0.2}, 3.0, -2.0, 0.1 + 0.2 / math.e),  # M2, at the speed at which 1/e is left
        ({"load_motor": 0.1, "load_external": 0.1}, 3.0, -2.0, 0.6),  # M3: |e - m| = 5
        ({"load_motor": 0.1, "load_external": 0.1}, 3.0, 2.0, 0.2),  # both push one way
        (
            {"load_motor": 0.1, "load_external": 0.1, "stribeck_load_motor": 0.2, "stribeck_load_external": 0.2},
            3.0,
            -2.0,
            0.6 + 1.0 / math.e,
        ),  # M4
        ({"load_motor": 0.1, "load_external": 0.4}, 3.0, -2.0, 1.2),  # M5: |-0.8 - 0.3|
        ({"quadratic_motor": 0.01, "quadratic_external": 0.02}, 3.0, -2.0, 0.1 + 0.08 / math.e),  # M6, driving
        ({"quadratic_motor": 0.01, "quadratic_external": 0.02}, 3.0, -4.0, 0.1 + 0.09 / math.e),  # driven back
        ({"quadratic_motor": 0.01, "quadratic_external": 0.02}, 3.0, 4.0, 0.1),  # no opposition
    ],
)
def test_the_largest_friction(terms, motor, external, limit):
    assert friction_limit(0.1, -2.0, motor, external, **(NONE | terms)) == pytest.approx(limit, rel=1e-14)


def flywheels(count=1, **terms):
    """Wheels of 1 kg·m² side by side, each with a motor of its own; their friction has these terms."""
    own = " ".join(str(float((NONE | {"mark": MARK} | terms)[name])) for name in FRICTION)
    wheel = f"""<body><joint name="{{0}}" axis="0 0 1" frictionloss="0.1" user="{own}"
        solimpfriction="0.9999 0.9999 0.001"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>"""
    motors = "".join(f'<motor name="m{index}" joint="w{index}"/>' for index in range(count))
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.001"/><worldbody>{"".join(wheel.format(f"w{i}") for i in range(count))}
        </worldbody><actuator>{motors}</actuator></mujoco>"""
    )


def spun(model, torque, speed, steps=1):
    """Speeds after steps under torques, from a speed."""
    callbacks.install()
    data = mujoco.MjData(model)
    data.qvel[:], data.ctrl[:] = speed, torque
    mujoco.mj_step(model, data, nstep=steps)
    return data.qvel.copy()


def test_friction_by_the_load_brakes_a_moving_wheel():
    """Of 3 N·m, 0.1 + 0.1 · 3 are lost: the wheel of 1 kg·m² gains 2.6 rad/s²."""
    gained = (spun(flywheels(load_motor=0.1, load_external=0.1), 3.0, 5.0, steps=10) - 5.0) / 0.01
    np.testing.assert_allclose(gained, 2.6, rtol=1e-3)


def test_friction_at_rest_holds_what_it_lets_move_at_speed():
    model = flywheels(stribeck=0.4, stribeck_speed=0.5, stribeck_exponent=2.0)
    np.testing.assert_allclose(spun(model, 0.45, 0.0, steps=100), 0.0, atol=1e-3)  # less than 0.1 + 0.4
    np.testing.assert_allclose(spun(model, 0.45, 10.0, steps=10), 10.0 + 0.0035, rtol=1e-6)  # 0.35 N·m are left


def test_each_joint_has_the_friction_of_its_own_load():
    """Wheels that share no constraint are islands of MuJoCo's solver, which keeps friction in a place of its own."""
    together = spun(flywheels(3, load_motor=0.2), [0.0, 1.0, -2.0], [5.0, 5.0, 5.0], steps=5)
    apart = [spun(flywheels(load_motor=0.2), torque, 5.0, steps=5)[0] for torque in (0.0, 1.0, -2.0)]
    np.testing.assert_allclose(together, apart, rtol=1e-9)
    np.testing.assert_allclose((together[2] - 5.0) / 0.005, -2.5, rtol=1e-3)


def test_a_model_without_user_data_of_ours_is_untouched():
    callbacks.install()
    model = flywheels(stribeck=1.0)
    model.jnt_user[:, 0] = 1.0
    np.testing.assert_allclose(spun(model, 0.0, 5.0, steps=10), 5.0 - 0.001, rtol=1e-6)


def test_a_drive_that_is_off_swings_free(tmp_path):
    """No torque and no back-EMF: the pendulum's energy stays, whatever is commanded; on, its back-EMF brakes it."""
    simulator = CpuSimulator(robots.load(write_robot(tmp_path, SERVO_SPEC, servo=SERVO)).task, threads=1)
    names = [channel.name for channel in simulator.task.actions]
    assert names == ["goal", "on", "volts", "p"]
    state, action = np.array([[[1.0, 0.0]]]), np.zeros((1, 1, 300, 4))
    action[..., names.index("on")] = -1.0
    action[..., names.index("goal")] = np.random.default_rng(0).uniform(-1, 1, 300)
    values = simulator.parameters.middle
    free = simulator.bind(values).roll_out(state, action)[0, 0]
    # J, of a point mass of 1 kg, 1 m from the axis.
    energy = 0.5 * free[:, 1] ** 2 + 9.81 * (1.0 - np.cos(free[:, 0]))
    np.testing.assert_allclose(energy, 9.81 * (1.0 - np.cos(1.0)), rtol=0.01)
    action[..., names.index("on")], action[..., names.index("goal")] = 1.0, 0.0
    braked = simulator.bind(values).roll_out(state, action)[0, 0]
    assert 0.5 * braked[-1, 1] ** 2 + 9.81 * (1.0 - np.cos(braked[-1, 0])) < 0.9 * energy[0]


def test_supply_and_gain_come_from_the_log(tmp_path):
    """At rest in the middle the torque is kt / R · gain · p · volts · goal."""
    simulator = CpuSimulator(robots.load(write_robot(tmp_path, SERVO_SPEC, servo=SERVO)).task, threads=1)
    system = simulator.bind(simulator.parameters.middle)
    middle, half = simulator.task.action_ranges
    given = np.array([[0.1, 1.0, 12.0, 2.0], [0.1, 1.0, 6.0, 2.0], [0.1, 1.0, 12.0, 5.0], [0.1, 0.0, 12.0, 5.0]])
    forces = system.actuator_forces(np.zeros((1, 4, 2)), ((given - middle) / half)[None])[0, :, :, 0]
    np.testing.assert_allclose(forces[:, 0], 0.5 / 2.0 * 0.2 * np.array([24.0, 12.0, 60.0, 0.0]) * 0.1, rtol=1e-12)
    np.testing.assert_array_equal(forces[:, 1:], 0.0)


def test_bits_depend_on_neither_threads_nor_what_ran_before(tmp_path):
    task = robots.load(write_robot(tmp_path, SERVO_SPEC, servo=SERVO)).task
    randomness, ends = np.random.default_rng(1), []
    state = randomness.uniform(-1, 1, (2, 20, 2))
    action = randomness.uniform(-1, 1, (2, 20, 40, 4))
    for threads in (1, 2):
        simulator = CpuSimulator(task, threads=threads)
        system = simulator.bind(
            simulator.parameters.to_physical(np.array([[-0.5], [0.5]]).repeat(len(task.parameters), 1))
        )
        ends.append(system.roll_out(state, action))
        half = system.roll_out(state, action[:, :, :20])[:, :, -1]
        again = CpuSimulator(task, threads=1).bind(
            simulator.parameters.to_physical(np.array([[-0.5], [0.5]]).repeat(len(task.parameters), 1))
        )
        np.testing.assert_array_equal(system.roll_out(half, action[:, :, 20:]), again.roll_out(half, action[:, :, 20:]))
    np.testing.assert_array_equal(*ends)


def test_an_exported_file_needs_no_madoc_and_is_refused_without_its_drives(tmp_path):
    shutil.copy(callbacks.__file__, tmp_path / "drives.py")
    own = " ".join(str(float((dict.fromkeys(DRIVE[-4:], -1) | {"mark": MARK} | DC).get(n, 0))) for n in DRIVE)
    (tmp_path / "model.xml").write_text(
        f"""<mujoco>
{callbacks.GUARD}<worldbody><body>
<joint name="a"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody>
<actuator><general name="a" joint="a" ctrlrange="-9 9" gainprm="0" biastype="user" user="{own}"/></actuator></mujoco>"""
    )
    with pytest.raises(ValueError, match=r"madoc\.drives"):
        mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    program = """
import sys, mujoco, drives
model = drives.load("model.xml")
data = mujoco.MjData(model)
data.ctrl[0] = 0.5
mujoco.mj_forward(model, data)
print(data.actuator_force[0], "madoc" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0.5", "False"]


def test_the_means_of_a_drive():
    assert MEANS == ("position", "velocity", "duty")
