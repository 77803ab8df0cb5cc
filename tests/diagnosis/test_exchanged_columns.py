"""Columns that are exchanged or reversed are told to be, and those of a right log are not."""

from dataclasses import replace

import numpy as np
import pytest
from logged_arm import SIGNALS, SPEC, TRUTH, arm_of, columns_of, write_csv

from madoc import simulation
from madoc.data import logs, typical_change
from madoc.diagnosis.exchanged_columns import exchanged_columns
from madoc.identification.replay import window_residuals
from madoc.identification.states import logged_states
from madoc.identification.windows import evenly, first_rows, windows_at
from robots import counted

DELAY = "  - {field: action_delay, low: 0, high: 0.06}\n"


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return arm_of(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def columns(robot):
    return columns_of(robot, 200)


@pytest.fixture
def told(robot, tmp_path):
    """What is found in a log of the arm, replayed at the truth."""

    def run(columns, unit=1.0):
        dataset = logs.read(write_csv(tmp_path / "log.csv", columns), robot)
        simulator = simulation.make(robot.task, threads=1)
        points = simulator.parameters.to_unit(TRUTH)[None]
        scale = unit * typical_change(dataset)
        findings, spent = counted(exchanged_columns, dataset, simulator, points, 10, scale, contradicts=True)
        assert spent > 0
        return [finding.what.partition(";")[0] for finding in findings]

    return run


def renamed(columns, **others):
    return columns | {name: columns[other] for name, other in others.items()}


def test_a_right_log_has_none(columns, told):
    assert told(columns) == []


def test_exchanged_joints(columns, told):
    joints = {"shoulder": "elbow", "shoulder_speed": "elbow_speed"}
    found = told(renamed(columns, **joints, **{other: name for name, other in joints.items()}))
    assert found == ["the joints shoulder and elbow are exchanged"]


def test_a_reversed_action(columns, told):
    found = told(columns | {"shoulder_torque": -columns["shoulder_torque"]})
    assert found == ["the action shoulder_torque has the other sign"]


def test_a_reversed_joint(columns, told):
    found = told(columns | {name: -columns[name] for name in ("elbow", "elbow_speed")})
    assert found == ["the joint elbow has the other sign"]


def test_errors_that_are_negligible_are_not_compared(columns, told):
    """Errors of an exact log are those of rounding: here all errors are made as small, in units of the changes."""
    assert told(columns | {name: -columns[name] for name in ("elbow", "elbow_speed")}, unit=1e5) == []


def test_a_log_is_predicted_in_its_windows_as_it_is_as_a_whole(tmp_path):
    """The ratio of errors is that of windows replayed from the whole log, whose states carry delayed actions."""
    robot, truth = arm_of(tmp_path, SPEC + DELAY), np.append(TRUTH, 0.03)
    columns, random = columns_of(robot, 200, truth=truth), np.random.default_rng(0)
    columns |= {name: columns[name] + 0.01 * random.standard_normal(200) for name in SIGNALS}
    right = logs.read(write_csv(tmp_path / "log.csv", columns), robot)
    turned, logged = np.array([1.0, -1.0, 1.0, -1.0]), right.transitions
    following = logged.next_observation * turned
    wrong = replace(
        right, transitions=replace(logged, observation=logged.observation * turned, next_observation=following)
    )
    simulator, scale = simulation.make(robot.task, threads=1), typical_change(right)
    points = simulator.parameters.to_unit(truth)[None]

    def error(dataset):
        states, rows = logged_states(dataset, robot.task)
        chosen = evenly(first_rows(dataset, rows, 10), 64)
        windows = windows_at(dataset, states[chosen], rows[chosen], 10)
        at_end = window_residuals(simulator, windows, points, scale)[..., -4:]
        return np.median(np.sqrt((at_end**2).mean(-1)), axis=1).min()

    (finding,), spent = counted(exchanged_columns, wrong, simulator, points, 10, scale, contradicts=True)
    times = f"{error(wrong) / error(right):.2g}"
    assert finding.what == f"the joint elbow has the other sign; put right, the log is predicted {times} times better"
    assert spent == 5 * 64 * 10  # as logged, and with one action or a joint reversed or both joints exchanged
