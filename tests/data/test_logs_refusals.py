"""Malformed logs, each answered with one sentence that says what, where and what to do."""

import json

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from logged_arm import ACTIONS, SIGNALS, arm_of, write_csv

from madoc.data import logs
from madoc.errors import MadocError


def changed(**columns):
    """A column replaced, or left out where None."""
    return lambda whole: {name: value for name, value in (whole | columns).items() if value is not None}


def at(name, row, value):
    """One value replaced."""

    def change(whole):
        values = whole[name].copy()
        values[row] = value
        return whole | {name: values}

    return change


def first_rows(count):
    return lambda whole: {name: values[:count] for name, values in whole.items()}


def times(factor):
    return lambda whole: whole | {"time": factor * whole["time"]}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            changed(elbow=None),
            "no column 'elbow' in log.csv; nearest: elbow_speed, elbow_torque; name it under log: columns:",
        ),
        (changed(time=None), "no column 'time' in log.csv; there are: shoulder, elbow"),
        (changed(time=None), "name it under log: time:"),
        (times(1e3), "expected time in s in log.csv, got steps of 20 where the control step is 0.02 s; is it in ms?"),
        (times(1e9), "is it in ns? divide it by 1e+09"),
        (
            times(0.5),
            "expected rows 0.02 s apart in log.csv, as control_step says, got 0.01 s (median)",
        ),
        (
            times(-1.0),
            "time to go forward in log.csv, got -0.02 after -0 in line 3 (49 such rows); sort the rows",
        ),
        (at("time", 7, 0.12), "got the time 0.12 twice in line 9 (1 such rows); keep one of the rows"),
        (at("time", 40, 0.0), "got 0 after 0.78 in line 42"),
        (
            at("shoulder_torque", 3, 0.9),
            "shoulder_torque within its range of [-0.5, 0.5] N·m, got 0.9 in line 5",
        ),
        (at("elbow_torque", 3, -1e-3), "expected elbow_torque within its range of [0, 0.4] N·m, got -0.001 in line 5"),
        (
            at("elbow", slice(0, 40), np.nan),
            "got NaN, infinity, more than 1e+30 or nothing in a signal or action in 40 of 50 rows",
        ),
        (at("time", slice(0, 40), np.inf), "got no finite time in column 'time' in 40 of 50 rows, the first line 2"),
        (at("elbow", slice(1, 50, 2), np.inf), "expected two rows in a row in log.csv"),
        (
            lambda whole: {name: values[:1] for name, values in whole.items()},
            "expected at least two rows in log.csv, got 1",
        ),
        (
            lambda whole: {name: values[:0] for name, values in whole.items()},
            "expected rows below the header of log.csv",
        ),
    ],
)
def test_a_bad_table(robot, columns, tmp_path, change, sentence):
    file = write_csv(tmp_path / "log.csv", change(columns))
    with pytest.raises(MadocError) as refusal:
        logs.read(file, robot)
    assert sentence in str(refusal.value)
    assert "\n" not in str(refusal.value)


def lines(change):
    """The lines of a good file, changed."""

    def write(path, columns):
        text = write_csv(path, columns).read_text().splitlines()
        path.write_text("\n".join(change(text)) + "\n")

    return write


def cell(text, line=12, column=2):
    def change(rows):
        cells = rows[line].split(",")
        return [*rows[:line], ",".join([*cells[:column], text, *cells[column + 1 :]]), *rows[line + 1 :]]

    return lines(change)


@pytest.mark.parametrize(
    ("write", "sentence"),
    [
        (
            cell("broken"),
            "expected a number in column 'elbow' of log.csv, got 'broken' in line 13; leave the",
        ),
        (cell('"1,5"'), "got '1,5' in line 13; a decimal comma?"),
        (cell("2026-11-21T12:00:00", column=0), "got '2026-11-21T12:00:00' in line 13; a date? write times as seconds"),
        (
            lines(lambda rows: [*rows[:-1], rows[-1][:20]]),
            "expected 7 cells in every line of log.csv",
        ),
        (lines(lambda rows: rows[1:]), "expected the names of the columns in the first line of log.csv"),
        (lines(lambda rows: [rows[0].replace("elbow_speed", "elbow"), *rows[1:]]), "got 'elbow' twice"),
        (lambda path, columns: path.write_text("\n\n"), "got no line with anything in it"),
        (lambda path, columns: path.write_bytes(b""), "log.csv is empty"),
        (lambda path, columns: path.write_bytes(b"time,\xff\n1,2\n"), "log.csv is not text in UTF-8"),
        (lambda path, columns: path.write_text('time,a\n0,"' + "x" * 200_000), "cannot read log.csv as CSV"),
        (lambda path, columns: None, "no file at"),
        (lambda path, columns: path.mkdir(), "expected logs in the folder"),
    ],
)
def test_a_bad_text(robot, columns, tmp_path, write, sentence):
    write(tmp_path / "log.csv", columns)
    with pytest.raises(MadocError) as refusal:
        logs.read(tmp_path / "log.csv", robot)
    assert sentence in str(refusal.value)
    assert "\n" not in str(refusal.value)


def cut(path):
    path.write_bytes(path.read_bytes()[:-200])


def write_npz(path, columns):
    np.savez(path, **columns)


def write_hdf5(path, columns):
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[name] = values


def write_parquet(path, columns):
    pq.write_table(pa.table(columns), path)


def write_mcap(path, columns):
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        channel = writer.register_channel("/arm", "json", writer.register_schema("arm", "jsonschema", b"{}"))
        for row in range(50):
            message = {name: float(values[row]) for name, values in columns.items()}
            writer.add_message(channel, row * 20_000_000, json.dumps(message).encode(), row * 20_000_000)
        writer.finish()


@pytest.mark.parametrize(
    ("suffix", "write"), [("npz", write_npz), ("h5", write_hdf5), ("parquet", write_parquet), ("mcap", write_mcap)]
)
def test_a_file_that_was_cut_short_or_is_of_another_kind(robot, columns, tmp_path, suffix, write):
    file = tmp_path / f"log.{suffix}"
    write(file, columns)
    cut(file)
    with pytest.raises(MadocError, match=r"cannot read .*log.*cut short"):
        logs.read(file, robot)
    file.write_bytes(b"anything else")
    with pytest.raises(MadocError, match=rf"log\.{suffix}"):
        logs.read(file, robot)


def test_a_byte_of_an_mcap_file_that_was_changed(robot, columns, tmp_path):
    write_mcap(tmp_path / "log.mcap", columns)
    content = bytearray((tmp_path / "log.mcap").read_bytes())
    place = content.index(b'"elbow": ') + 10
    content[place] ^= 1  # another digit
    (tmp_path / "log.mcap").write_bytes(bytes(content))
    with pytest.raises(MadocError, match=r"cannot read log\.mcap"):
        logs.read(tmp_path / "log.mcap", robot)


def test_columns_of_unequal_lengths(robot, columns, tmp_path):
    np.savez(tmp_path / "log.npz", **(columns | {"elbow": columns["elbow"][:-1]}))
    with pytest.raises(
        MadocError, match=r"'shoulder' and 'elbow' .* not logged together, row by row \(50 and 49 rows\)"
    ):
        logs.read(tmp_path / "log.npz", robot)


def test_a_picture_is_no_column(robot, columns, tmp_path):
    np.savez(tmp_path / "log.npz", **(columns | {"elbow": np.zeros((50, 4, 4))}))
    with pytest.raises(MadocError, match=r"numbers in column 'elbow' of log.npz, got an array of shape \(50, 4, 4\)"):
        logs.read(tmp_path / "log.npz", robot)


def test_a_column_that_the_spec_names_and_the_log_lacks(columns, tmp_path):
    robot = arm_of(tmp_path, log="{columns: {elbow: joint_2}}")
    with pytest.raises(MadocError, match=r"no column 'joint_2' \(which log: columns: names for elbow\)"):
        logs.read(write_csv(tmp_path / "log.csv", columns), robot)


def test_most_steps_jitter(columns, tmp_path):
    time = columns["time"] + 0.004 * (np.arange(50) % 2)  # steps of 24 and of 16 ms
    with pytest.raises(MadocError, match=r"most time steps .* more than 10 % off .* raise log: tolerance, or ask"):
        logs.read(write_csv(tmp_path / "log.csv", columns | {"time": time}), arm_of(tmp_path))
    robot = arm_of(tmp_path, log="{tolerance: 0.25}")
    (note,) = logs.read(tmp_path / "log.csv", robot).findings
    assert note.level == "note"
    assert note.what == "time steps scatter by 20 % of the control step (standard deviation)"


@pytest.mark.parametrize(
    ("spacing", "words"),
    [
        (0.0214, "got 0.0214 s on average, 7 % more: speeds and accelerations"),
        (0.0194, "got 0.0194 s on average, 3 % less: speeds"),
        (
            0.02 + 4e-5 * np.arange(50),
            r"5 % more \(0.02004 s apart at the beginning .* and 0.02196 s at its end\): speeds",
        ),
    ],
)
def test_a_mean_rate_that_would_make_every_estimate_wrong(robot, columns, tmp_path, spacing, words):
    """Each row is within the tolerance of 10 % of a control step, and the mean is not."""
    time = np.cumsum(np.full(50, spacing))
    with pytest.raises(MadocError, match=words):
        logs.read(write_csv(tmp_path / "log.csv", columns | {"time": time}), robot)


def test_a_rate_that_is_a_little_off(robot, columns, tmp_path):
    (warning,) = logs.read(write_csv(tmp_path / "log.csv", columns | {"time": 0.0203 * np.arange(50)}), robot).findings
    assert warning.level == "warning"
    assert warning.what == "rows are 0.0203 s apart on average, 1.5 % more than the control step of 0.02 s"


def test_a_clock_that_drifts(robot, columns, tmp_path):
    """Rows are 0.0195 s apart at first and 0.0205 s at the end, a control step on average."""
    time = np.cumsum(np.linspace(0.0195, 0.0205, 50))
    (warning,) = logs.read(write_csv(tmp_path / "log.csv", columns | {"time": time}), robot).findings
    assert warning.level == "warning"
    assert "drifts: 0.01952 s apart at the beginning of the run and 0.0205 s at its end" in warning.what


def test_topics_that_do_not_overlap_in_time(columns, tmp_path):
    pairs = ", ".join([f"{name}: 'one.{name}'" for name in SIGNALS] + [f"{name}: 'two.{name}'" for name in ACTIONS])
    robot = arm_of(tmp_path, log=f"{{resample: hold, columns: {{{pairs}}}}}")
    from mcap.writer import Writer

    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, names, start in (("one", SIGNALS, 0), ("two", ACTIONS, 10**10)):
            channel = writer.register_channel(topic, "json", 0)
            for row in range(50):
                message = {name: float(columns[name][row]) for name in names}
                at_ns = start + row * 20_000_000
                writer.add_message(channel, at_ns, json.dumps(message).encode(), at_ns)
        writer.finish()
    with pytest.raises(MadocError, match=r"expected all columns of log.mcap to be logged at the same time"):
        logs.read(tmp_path / "log.mcap", robot)


def test_a_file_that_no_reader_knows(robot, tmp_path):
    (tmp_path / "log.bag").write_bytes(b"#ROSBAG")
    with pytest.raises(MadocError, match=r"expected a log that ends in \.csv, .*, got .*log\.bag; convert it"):
        logs.read(tmp_path / "log.bag", robot)


def test_lerobot_without_data(robot, tmp_path):
    (tmp_path / "logs" / "meta").mkdir(parents=True)
    (tmp_path / "logs" / "meta" / "info.json").write_text('{"features": {}}')
    with pytest.raises(MadocError, match="logs is no whole LeRobot dataset: no Parquet file in its folder data"):
        logs.read(tmp_path / "logs", robot)


def test_lerobot_without_episodes(robot, tmp_path):
    for folder in ("meta", "data"):
        (tmp_path / "logs" / folder).mkdir(parents=True)
    (tmp_path / "logs" / "meta" / "info.json").write_text('{"features": {}}')
    pq.write_table(pa.table({"episode_index": pa.array([], pa.int64())}), tmp_path / "logs" / "data" / "file.parquet")
    with pytest.raises(MadocError, match=r"expected at least one episode in .*logs, got none"):
        logs.read(tmp_path / "logs", robot)
