"""Columns that are exchanged or reversed are told to be, and those of a right log are not."""

import pytest
from logged_arm import TRUTH, arm_of, columns_of, write_csv

from madoc import simulation
from madoc.data import logs, typical_change
from madoc.diagnosis.exchanged_columns import exchanged_columns


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return arm_of(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def columns(robot):
    return columns_of(robot, 200)


@pytest.fixture
def told(robot, tmp_path):
    """What is found in a log of the arm, replayed at the truth."""

    def run(columns):
        dataset = logs.read(write_csv(tmp_path / "log.csv", columns), robot)
        simulator = simulation.make(robot.task, threads=1)
        points = simulator.parameters.to_unit(TRUTH)[None]
        findings, spent = exchanged_columns(dataset, simulator, points, 10, typical_change(dataset), contradicts=True)
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
