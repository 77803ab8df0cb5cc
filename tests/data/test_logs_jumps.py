"""Angles that wrap around, episodes in one table, copies of a run, and what resampling makes of time."""

import numpy as np
import pytest
from logged_arm import SPEC, arm_of, columns_of, write_csv

from madoc.data import logs
from madoc.data.logs.tables import Table
from madoc.data.logs.timing import Series, held_finding
from madoc.errors import MadocError


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return arm_of(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def resampled(tmp_path_factory):
    return arm_of(tmp_path_factory.mktemp("resampled"), log="{resample: linear}")


@pytest.fixture
def columns(robot):
    """A log whose shoulder turns around one and a half times, steadily."""
    whole = columns_of(robot)
    return whole | {"shoulder": np.linspace(0.0, 3.0 * np.pi, 50)}


def wrapped(angle, turn=2.0 * np.pi):
    return (angle + turn / 2.0) % turn - turn / 2.0


def sentences(dataset):
    return [finding.sentence for finding in dataset.findings]


def test_an_angle_that_wraps_around_is_unwrapped_and_told(robot, columns, tmp_path):
    path = write_csv(tmp_path / "log.csv", columns | {"shoulder": wrapped(columns["shoulder"])})
    dataset = logs.read(path, robot)
    np.testing.assert_allclose(dataset.transitions.observation[:, 0], columns["shoulder"][:-1], atol=1e-9)
    (told,) = sentences(dataset)
    assert told.startswith("log.csv: column 'shoulder' jumps by a whole turn in 2 rows: it was unwrapped")


def test_a_reading_that_is_lost_at_a_wrap_does_not_lose_the_turn(robot, columns, tmp_path):
    angle = wrapped(columns["shoulder"])
    angle[17] = np.nan  # just after the first wrap
    dataset = logs.read(write_csv(tmp_path / "log.csv", columns | {"shoulder": angle}), robot)
    np.testing.assert_allclose(dataset.transitions.next_observation[-1, 0], columns["shoulder"][-1], atol=1e-9)


def test_angles_are_unwrapped_before_they_are_interpolated(resampled, columns, tmp_path):
    late = columns["time"] + 0.01 * (np.arange(50) % 2)  # rows are 10 and 30 ms apart
    path = write_csv(tmp_path / "log.csv", columns | {"shoulder": wrapped(columns["shoulder"]), "time": late})
    seen = logs.read(path, resampled).transitions.observation[:, 0]
    np.testing.assert_allclose(seen, np.interp(0.02 * np.arange(len(seen)), late, columns["shoulder"]), atol=1e-9)


def test_a_turn_is_in_the_unit_of_the_signal(columns, tmp_path):
    degrees = SPEC.replace("reads: position(shoulder)", "reads: position(shoulder) * 180 / pi, unit: deg")
    robot = arm_of(tmp_path, degrees)
    angle = np.degrees(columns["shoulder"])
    dataset = logs.read(write_csv(tmp_path / "log.csv", columns | {"shoulder": wrapped(angle, 360.0)}), robot)
    np.testing.assert_allclose(dataset.transitions.observation[:, 0], angle[:-1], atol=1e-9)


def test_an_angle_as_fast_as_a_turn_a_row_is_left_alone(robot, columns, tmp_path):
    fast = columns["shoulder"] + 2.0 * np.pi * (np.arange(50) % 2)
    dataset = logs.read(write_csv(tmp_path / "log.csv", columns | {"shoulder": fast}), robot)
    np.testing.assert_allclose(dataset.transitions.observation[:, 0], fast[:-1])
    assert not dataset.findings


@pytest.mark.parametrize(
    "column",
    [
        {"Episode": np.repeat([3.0, 4.0, 9.0], [20, 10, 20])},
        {"terminals": np.isin(np.arange(50), [19]) * 1.0, "timeouts": np.isin(np.arange(50), [29, 49]) * 1.0},
    ],
    ids=["numbered", "flagged"],
)
def test_episodes_in_one_table_are_cut(robot, resampled, columns, tmp_path, column):
    path = write_csv(tmp_path / "log.csv", columns | column)
    dataset = logs.read(path, robot)
    assert (dataset.episode_ends - dataset.episode_starts).tolist() == [19, 9, 19]
    assert sentences(dataset) == ["log.csv: it holds 3 episodes: it is cut between them"]
    assert (logs.read(path, resampled).episode_starts == dataset.episode_starts).all()


def test_nothing_is_interpolated_from_one_episode_to_the_next(resampled, columns, tmp_path):
    later = columns | {"time": columns["time"] + 0.01, "trial": np.repeat([0.0, 1.0], 25)}
    later["time"][0] = 0.0
    angle = np.repeat([0.0, 3.0], 25)
    dataset = logs.read(write_csv(tmp_path / "log.csv", later | {"shoulder": angle}), resampled)
    assert set(dataset.transitions.observation[:, 0]) | set(dataset.transitions.next_observation[:, 0]) == {0.0, 3.0}
    assert len(dataset.episode_starts) == 2


def test_a_copy_of_a_run_is_left_out_and_told(robot, columns, tmp_path):
    for name in ("a.csv", "b.csv"):
        write_csv(tmp_path / name, columns)
    other = write_csv(tmp_path / "c.csv", columns | {"elbow": columns["elbow"] + 0.1})
    dataset = logs.read([tmp_path, other], robot)
    assert dataset.run_names == ("a.csv", "c.csv")
    assert [told.split(";")[0] for told in sentences(dataset)] == [
        "b.csv: it holds the same rows as a.csv and is left out",
        "c.csv (2): it holds the same rows as c.csv and is left out",
    ]


def test_clipped_actions_are_counted(robot, columns, tmp_path):
    torque = columns["shoulder_torque"].copy()
    torque[[3, 8]] = 0.9
    path = write_csv(tmp_path / "log.csv", columns | {"shoulder_torque": torque})
    dataset = logs.read(path, robot, clip_actions=True)
    assert sentences(dataset) == ["log.csv: 2 of 49 values of shoulder_torque were clipped to its range"]


def test_a_quotation_mark_that_is_never_closed_is_refused(robot, columns, tmp_path):
    path = write_csv(tmp_path / "log.csv", columns)
    lines = path.read_text().splitlines()
    notes = ["note", *("" for _ in range(49))]
    notes[7] = '"operator touched arm'
    path.write_text("\n".join(f"{line},{note}" for line, note in zip(lines, [*notes, ""], strict=True)))
    with pytest.raises(MadocError, match="got a quotation mark that opens in line 8 and is not closed there"):
        logs.read(path, robot)


@pytest.mark.parametrize(
    ("factor", "sentence"),
    [
        (1e3, "got steps of 20 where the control step is 0.02 s; is it in ms"),
        (1e9, "is it in ns"),
        (4e2, r"got 50 rows in 392 s, which resampling would make 19,601; is time in s\?"),
    ],
)
def test_time_in_another_unit_is_not_resampled(resampled, columns, tmp_path, factor, sentence):
    path = write_csv(tmp_path / "log.csv", columns | {"time": factor * columns["time"]})
    with pytest.raises(MadocError, match=sentence):
        logs.read(path, resampled)


def test_a_command_that_is_held_for_long_is_told():
    times = np.arange(0.0, 1.0, 0.1)
    commands = Series(times, times[:, None], Table({"time": times}), np.arange(10), "log.mcap")
    assert held_finding(commands, 1.1) == []
    (told,) = held_finding(commands, 3.0)
    assert told.sentence.startswith("log.mcap: its last action is 2.1 s before its last signal, and is held until then")
