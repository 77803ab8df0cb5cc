"""Angles that wrap around, episodes in one table, copies of a run, and what resampling makes of time."""

import numpy as np
import pytest
from logged_arm import SPEC, arm_of, columns_of, write_csv

from madoc.data import logs
from madoc.data.logs.jumps import split_episodes
from madoc.data.logs.tables import Run, Table
from madoc.data.logs.timing import Series, held_finding
from madoc.errors import MadocError
from robots import ARM


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


def test_a_fast_angle_is_unwrapped_the_shorter_way(robot, columns, tmp_path):
    wheel = 2.0 * np.pi * 0.12 * np.arange(50)
    dataset = logs.read(write_csv(tmp_path / "log.csv", columns | {"shoulder": wrapped(wheel)}), robot)
    np.testing.assert_allclose(np.diff(dataset.transitions.observation[:, 0]), 2.0 * np.pi * 0.12, atol=1e-9)


@pytest.mark.parametrize("angle", [2.0 * np.pi * 0.3 * np.arange(50), 4.0 * np.pi * (np.arange(50) % 2)])
def test_an_angle_that_may_have_gone_either_way_or_does_not_wrap_is_left_alone(robot, columns, tmp_path, angle):
    angle = wrapped(angle) if angle.max() > 20.0 else angle
    dataset = logs.read(write_csv(tmp_path / "log.csv", columns | {"shoulder": angle}), robot)
    np.testing.assert_allclose(dataset.transitions.observation[:, 0], angle[:-1])
    assert not dataset.findings


@pytest.mark.parametrize(
    "column",
    [
        {"Episode": np.repeat([3.0, 4.0, 9.0], [20, 10, 20])},
        {"terminals": np.isin(np.arange(50), [19]) * 1.0, "timeouts": np.isin(np.arange(50), [29, 49]) * 1.0},
        {"done": np.isin(np.arange(50), [19]) * 1.0, "is_last": (np.arange(50) >= 29) * 1.0},
    ],
    ids=["numbered", "flagged", "latched"],
)
@pytest.mark.parametrize("restarting", [False, True])
def test_episodes_of_one_table_are_runs_of_their_own(robot, resampled, columns, tmp_path, column, restarting):
    time = np.concatenate([0.02 * np.arange(count) for count in (20, 10, 20)])
    changed = columns | column | ({"time": time} if restarting else {"time": np.cumsum(np.full(50, 0.02))})
    path = write_csv(tmp_path / "log.csv", changed)
    for reader in (robot, resampled):
        dataset = logs.read(path, reader)
        assert (dataset.episode_ends - dataset.episode_starts).tolist() == [19, 9, 19]
        assert dataset.run_names == tuple(f"log.csv, episode {number}" for number in (1, 2, 3))
        assert sentences(dataset)[0] == "log.csv: it holds 3 episodes"
        assert not any(finding.level == "warning" for finding in dataset.findings)


@pytest.mark.parametrize("unset", ["0.000000", "False", "", "no", b"False", None])
def test_flags_that_are_not_set_cut_nothing(unset):
    flags = np.array([unset] * 5 + ["True"], dtype=object)
    table = Table({"q": np.arange(6.0), "done": flags, "trial": np.array([None] * 6, dtype=object)})
    run = Run("log.csv", (table,))
    assert split_episodes(run, {"q"}) == ([run], [])


def test_a_reset_between_two_episodes_is_no_turn(robot, columns, tmp_path):
    angle = np.concatenate([np.linspace(0.0, 3.0, 25), np.linspace(-3.0, 0.0, 25)])
    path = write_csv(tmp_path / "log.csv", columns | {"elbow": angle, "trial": np.repeat([0.0, 1.0], 25)})
    seen = logs.read(path, robot).transitions
    assert (seen.observation[:, 1].min(), seen.next_observation[:, 1].max()) == (-3.0, 3.0)


def test_nothing_is_interpolated_from_one_episode_to_the_next(resampled, columns, tmp_path):
    done, elbow = np.zeros(50), columns["elbow"].copy()
    done[19], elbow[19] = 1.0, np.nan  # the row that ends the episode is lost
    angle = np.repeat([0.0, 3.0], [20, 30])
    path = write_csv(tmp_path / "log.csv", columns | {"shoulder": angle, "elbow": elbow, "done": done})
    dataset = logs.read(path, resampled)
    assert set(dataset.transitions.observation[:, 0]) | set(dataset.transitions.next_observation[:, 0]) == {0.0, 3.0}
    assert len(dataset.episode_starts) == 2


def test_an_episode_of_one_row_is_left_out_and_told(robot, columns, tmp_path):
    path = write_csv(tmp_path / "log.csv", columns | {"episode": np.repeat([0.0, 1.0, 2.0], [20, 1, 29])})
    dataset = logs.read(path, robot)
    assert sentences(dataset) == ["log.csv: it holds 3 episodes, of which 1 have one row and are left out"]
    assert dataset.run_names == ("log.csv, episode 1", "log.csv, episode 3")


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
        (50.0, r"got 50 rows in 49 s, which resampling would make 2,451; is time in s\?"),
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


def test_a_quaternion_that_changes_its_sign_is_made_continuous(tmp_path):
    model = ARM.replace(
        "<worldbody>", '<worldbody><body name="ball"><joint name="ball" type="ball"/><geom size=".1"/></body>'
    )
    parts = "".join(f"  - {{name: q{part}, reads: 'position(ball)[{part}]'}}\n" for part in range(4))
    robot = arm_of(tmp_path, SPEC.replace("signals:\n", f"signals:\n{parts}"), model=model)
    assert [signal.quaternion for signal in robot.signals] == ["ball"] * 4 + [""] * 4
    columns = columns_of(robot)
    half = np.linspace(0.0, 1.5 * np.pi, 50)
    turning = {"q0": np.cos(half), "q1": np.sin(half), "q2": 0.0 * half, "q3": 0.0 * half}
    positive = np.where(turning["q0"] < 0.0, -1.0, 1.0)
    logged = columns | {name: positive * part for name, part in turning.items()}
    dataset = logs.read(write_csv(tmp_path / "log.csv", logged), robot)
    expected = np.stack([turning["q0"], turning["q1"]], axis=-1)[:-1]
    np.testing.assert_allclose(dataset.transitions.observation[:, :2], expected, atol=1e-8)
    assert any("the quaternion of 'ball' changes its sign in 1 rows" in each for each in sentences(dataset))
