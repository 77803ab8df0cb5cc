"""Positions and speeds compared: the true rate of rows, and speeds that come late."""

import numpy as np
import pytest
from logged_arm import arm_of, write_csv
from mujoco_log import recorded

from madoc import simulation
from madoc.data import logs
from madoc.diagnosis import speeds
from madoc.diagnosis.speeds import impacts, speed_findings


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
