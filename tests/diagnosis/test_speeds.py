"""Positions and speeds compared: the true rate of rows, and speeds that come late."""

import jax
import numpy as np
import pytest
from logged_arm import arm_of, write_csv
from mujoco_log import recorded

from madoc import robots, simulation
from madoc.data import logs
from madoc.diagnosis import speeds
from madoc.diagnosis.speeds import impacts, rates_contradict, speed_findings
from own_robots import write_robot
from robots import recorded as recorded_robot


@pytest.fixture
def told(tmp_path):
    """The findings on a log of the arm, as (where, what), and whether speeds are late."""

    def run(columns):
        robot = arm_of(tmp_path)
        dataset = logs.read(write_csv(tmp_path / "log.csv", columns), robot)
        found, late = speed_findings(dataset, simulation.make(robot.task, threads=1))
        return [(finding.where, finding.what) for finding in found], late

    return run


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_an_honest_log_raises_nothing(told, noise):
    assert told(recorded(noise=noise)) == ([], False)


def test_speeds_that_shake_faster_than_the_rows_contradict_nothing(told):
    """A mean of two readings has two thirds of its variance from the motion, as much as the slope and r² are."""
    columns = recorded()
    shaken = columns["shoulder_speed"] + columns["shoulder_speed"].std() * np.random.default_rng(0).standard_normal(
        len(columns["shoulder_speed"])
    )
    mean = 0.5 * (shaken[1:] + shaken[:-1])
    change = np.diff(columns["shoulder"])
    slope, inverse = speeds._ratios(change, mean * 0.02)
    assert 0.5 < slope < 0.8 and inverse == pytest.approx(1.0, abs=0.1)
    assert not [what for _, what in told({**columns, "shoulder_speed": shaken})[0] if "times as fast" in what]


@pytest.mark.parametrize(("spacing", "ratio"), [(0.0212, "1.06"), (0.019, "0.95")])
def test_rows_farther_apart_than_their_times_say(told, spacing, ratio):
    """Positions change by speed times the true spacing, and the time column says 0.02 s."""
    (finding,), late = told(recorded(spacing=spacing))
    assert finding[0] in ("shoulder", "elbow")
    assert finding[1].startswith(f"it changes {ratio}")
    assert not late


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_a_joint_that_moves_now_and_then(told, noise):
    """It goes to and fro smoothly in one second of ten, speeds 6 % too low: no change of them is an impact."""
    time, random = 0.02 * np.arange(6000), np.random.default_rng(0)
    columns = {"time": time, "shoulder_torque": np.zeros(6000), "elbow_torque": np.zeros(6000)}
    share, sign = np.clip(time % 10.0, 0.0, 1.0), (-1.0) ** (time // 10.0)
    angle = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    speed = 30.0 * (share * (1.0 - share)) ** 2
    for name in ("shoulder", "elbow"):
        columns[name] = np.where(sign > 0, angle, 1.0 - angle) + noise * random.standard_normal(6000)
        columns[f"{name}_speed"] = 0.94 * sign * speed + noise * random.standard_normal(6000)
    (finding,), _ = told(columns)
    assert finding[1].startswith("it changes 1.06")


def test_speeds_that_are_two_rows_late(told):
    columns = recorded()
    columns |= {name: np.roll(columns[name], 2) for name in ("shoulder_speed", "elbow_speed")}
    found, late = told({name: values[2:] for name, values in columns.items()})
    assert late
    assert [where for where, _ in found if where.endswith("speed")] == ["shoulder_speed", "elbow_speed"]
    assert all(what.startswith("it comes 0.0") for where, what in found if where.endswith("speed"))


@pytest.mark.parametrize("trembling", [0.0, 1e-9])
def test_joints_that_move_in_one_part_of_the_log_alone(told, trembling):
    """They go up and down once, from 22 s to 23 s of a minute; without that part nothing is left to regress on."""
    time = 0.02 * np.arange(3000)
    phase = 2.0 * np.pi * np.clip(time - 22.0, 0.0, 1.0)
    columns = {"time": time, "shoulder_torque": np.zeros(3000), "elbow_torque": np.zeros(3000)}
    for name in ("shoulder", "elbow"):
        columns[name] = 0.1 * (1.0 - np.cos(phase)) + trembling * np.sin(time)
        columns[f"{name}_speed"] = 0.2 * np.pi * np.sin(phase) + trembling * np.cos(time)
    assert told(columns) == ([], False)


SERVO = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="fin"><joint name="fin" type="hinge" axis="0 0 1" damping="0.08"/>
    <geom type="box" size="0.1 0.01 0.01" mass="0.1"/></body></worldbody>
  <actuator><position name="servo" joint="fin" kp="1"/></actuator>
</mujoco>
"""
SERVO_SPEC = """\
madoc: 1
name: servo
model: servo.xml
control_step: 0.02
signals:
  - {name: fin, reads: position(fin)}
  - {name: fin_speed, reads: velocity(fin)}
actions:
  - {name: target, actuator: servo, low: -1, high: 1}
parameters:
  - {field: dof_damping, element: fin, low: 0.002, high: 0.4}
"""


def test_a_drive_that_follows_within_a_row_moves_faster_between_rows(tmp_path):
    """The model at the truth says what positions of a log without noise change by beyond the mean of two speeds."""
    task = robots.load(write_robot(tmp_path, SERVO_SPEC, servo=SERVO)).task
    log, simulator = recorded_robot(task, {"dof_damping.fin": 0.04}, 200, jax.random.key(0)), simulation.make(task)
    (pair,) = speeds._pairs(log, simulator)
    within = speeds._within_rows(log, simulator, np.array([0.04]))
    assert np.abs(within).max() > 0.5 * np.abs(pair.change).max()
    np.testing.assert_allclose(pair.expected + within[:, pair.dof], pair.change, atol=1e-9)


@pytest.mark.parametrize(("moves_so", "contradict"), [(0.0, True), (0.06, False)])
def test_an_estimate_that_moves_so_refutes_other_rates_of_rows(tmp_path, monkeypatch, moves_so, contradict):
    """Positions change by 6 % more than speeds say, and so do those of the model at the estimate, or not."""
    robot = arm_of(tmp_path)
    dataset = logs.read(write_csv(tmp_path / "log.csv", recorded(spacing=0.0212)), robot)
    simulator = simulation.make(robot.task, threads=1)
    (finding,), _ = speed_findings(dataset, simulator)
    assert finding.of_rows and finding.contradicts
    by_speed = np.stack([pair.expected for pair in speeds._pairs(dataset, simulator)], axis=-1)
    monkeypatch.setattr(speeds, "_within_rows", lambda *_: moves_so * by_speed)
    assert rates_contradict(dataset, simulator, simulator.parameters.middle) == contradict


def test_impacts_are_left_out_and_steps_of_an_encoder_are_not():
    random, step, height, speed = np.random.default_rng(0), 0.002, 1.0, 0.0
    logged, bounced = [], []
    for _ in range(2000):
        speed -= 9.81 * step
        height += step * speed
        bounced.append(height < 0.0)
        if bounced[-1]:
            height, speed = -height, -0.8 * speed
        logged.append(speed + 0.01 * random.standard_normal())
    np.testing.assert_array_equal(impacts(np.diff(logged)), bounced[1:])
    angle = np.sin(3.0 * np.arange(5000) / 1000.0)
    speeds = 1000.0 * np.diff(np.round(angle / 0.0015) * 0.0015)
    assert not impacts(np.diff(speeds)).any()
    assert not impacts(np.zeros(5)).any()
