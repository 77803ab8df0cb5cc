"""Every format is written here and read back to the same numbers."""

import contextlib
import json
import sqlite3
import sys
import warnings
import zipfile

import gymnasium
import h5py
import minari
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from logged_arm import ACTIONS, SIGNALS, arm_of, columns_of, write_csv
from mcap.writer import Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosWriter
from rosbags.typesys import Stores, get_typestore

from madoc.data import logs
from madoc.data.findings import Finding
from madoc.data.logs import mcap_reader, parquet_reader
from madoc.errors import MadocError


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return arm_of(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def columns(robot):
    return columns_of(robot)


def matrix(columns, names):
    return np.stack([columns[name] for name in names], axis=-1)


def assert_same(dataset, columns, *, atol=0.0):
    """One episode that holds exactly the columns, actions brought to [-1, 1] by hand."""
    seen = matrix(columns, SIGNALS)
    unit = np.stack([columns["shoulder_torque"] / 0.5, columns["elbow_torque"] / 0.2 - 1.0], axis=-1)
    logged = dataset.transitions
    np.testing.assert_allclose(logged.observation, seen[:-1], rtol=0, atol=atol)
    np.testing.assert_allclose(logged.next_observation, seen[1:], rtol=0, atol=atol)
    np.testing.assert_allclose(logged.action, unit[:-1], rtol=0, atol=1e-12 + atol)
    assert dataset.episode_starts.tolist() == [0]
    assert logged.truncated.tolist() == [False] * (len(seen) - 2) + [True]
    assert not logged.terminated.any()
    assert not logged.reward.any()


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_csv(robot, columns, tmp_path, separator):
    dataset = logs.read(write_csv(tmp_path / "log.csv", columns, separator), robot)
    assert_same(dataset, columns)
    assert dataset.run_names == ("log.csv",)
    assert dataset.findings == ()


def test_csv_with_text_in_other_columns_quotes_and_a_byte_order_mark(robot, columns, tmp_path):
    lines = write_csv(tmp_path / "plain.csv", columns).read_text().splitlines()
    lines = [f'"mode, set",{lines[0]}', *(f'"auto, slow",{line}' for line in lines[1:])]
    file = tmp_path / "log.csv"
    file.write_text("\ufeff# recorded by hand\n" + "\n".join(lines) + "\n\n")
    assert_same(logs.read(file, robot), columns)


def test_csv_as_numpy_writes_it(robot, columns, tmp_path):
    file = tmp_path / "log.csv"
    np.savetxt(file, np.stack(list(columns.values()), axis=-1), delimiter=",", header=",".join(columns), fmt="%.17g")
    assert_same(logs.read(file, robot), columns)


def test_npz(robot, columns, tmp_path):
    np.savez(tmp_path / "log.npz", **columns, serial_number=np.array(7))
    assert_same(logs.read(tmp_path / "log.npz", robot), columns)


def named(signal, action, time="time"):
    """The `log:` section where signals and actions are elements of arrays."""
    pairs = [f"{name}: '{signal}[{index}]'" for index, name in enumerate(SIGNALS)]
    pairs += [f"{name}: '{action}[{index}]'" for index, name in enumerate(ACTIONS)]
    return f"{{time: {time}, columns: {{{', '.join(pairs)}}}}}"


def test_npz_of_matrices(columns, tmp_path):
    robot = arm_of(tmp_path, log=named("seen", "done", "t"))
    np.savez(tmp_path / "log.npz", seen=matrix(columns, SIGNALS), done=matrix(columns, ACTIONS), t=columns["time"])
    assert_same(logs.read(tmp_path / "log.npz", robot), columns)


def test_hdf5(robot, columns, tmp_path):
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for name, values in columns.items():
            file[name] = values
        file["camera/images"] = np.zeros((50, 4, 4, 3), np.uint8)
    assert_same(logs.read(tmp_path / "log.h5", robot), columns)


def test_hdf5_with_a_group_a_run(columns, tmp_path):
    robot = arm_of(tmp_path, log=named("obs/state", "actions", "stamps"))
    with h5py.File(tmp_path / "log.hdf5", "w") as file:
        for name in ("demo_10", "demo_2"):
            file[f"data/{name}/obs/state"] = matrix(columns, SIGNALS) + (name == "demo_10")
            file[f"data/{name}/actions"] = matrix(columns, ACTIONS)
            file[f"data/{name}/stamps"] = columns["time"]
    dataset = logs.read(tmp_path / "log.hdf5", robot)
    assert dataset.run_names == ("log.hdf5/data/demo_2", "log.hdf5/data/demo_10")
    assert dataset.episode_starts.tolist() == [0, 49]
    np.testing.assert_array_equal(dataset.transitions.observation[49:], dataset.transitions.observation[:49] + 1)


def test_parquet(robot, columns, tmp_path):
    pq.write_table(pa.table({**columns, "label": ["a"] * 50}), tmp_path / "log.parquet")
    assert_same(logs.read(tmp_path / "log.parquet", robot), columns)


def test_parquet_of_lists_and_dates(columns, tmp_path):
    robot = arm_of(tmp_path, log=named("seen", "done", "at"))
    nanoseconds = 1_700_000_000_000_000_000 + np.arange(50) * 20_000_000
    lists = {"seen": matrix(columns, SIGNALS).tolist(), "done": matrix(columns, ACTIONS).tolist()}
    pq.write_table(pa.table({**lists, "at": pa.array(nanoseconds, pa.timestamp("ns"))}), tmp_path / "log.parquet")
    assert_same(logs.read(tmp_path / "log.parquet", robot), columns)


@pytest.mark.parametrize("kind", [pa.list_(pa.float64()), pa.list_(pa.float64(), 2), pa.large_list(pa.float64())])
def test_parquet_of_lists_with_missing_rows(tmp_path, kind):
    file = tmp_path / "log.parquet"
    pq.write_table(pa.table({"pair": pa.array([[1.0, 2.0], None, [3.0, 4.0]], kind)}), file, row_group_size=1)
    read, _ = parquet_reader.read_columns(file, {"pair"})
    np.testing.assert_array_equal(read["pair"], [[1, 2], [np.nan, np.nan], [3, 4]])
    pq.write_table(pa.table({"pair": pa.array([], kind)}), file)
    assert parquet_reader.read_columns(file, {"pair"})[0]["pair"].size == 0


def test_parquet_of_lists_of_unequal_lengths(tmp_path):
    pq.write_table(pa.table({"pair": [[1.0, 2.0], [3.0]]}), tmp_path / "log.parquet")
    with pytest.raises(MadocError, match=r"as many values in every row of a list column of log.parquet, got 1 and 2"):
        parquet_reader.read_columns(tmp_path / "log.parquet", {"pair"})


def lerobot(folder, columns, *, together):
    """Two episodes, of one file each (version 2) or of one file (version 3)."""
    tables = []
    for episode in (0, 1):
        tables.append(
            pa.table(
                {
                    "observation.state": (matrix(columns, SIGNALS) + episode).astype(np.float32).tolist(),
                    "action": matrix(columns, ACTIONS).astype(np.float32).tolist(),
                    "timestamp": columns["time"].astype(np.float32),
                    "frame_index": np.arange(50),
                    "episode_index": np.full(50, episode),
                }
            )
        )
    chunk = folder / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    if together:
        pq.write_table(pa.concat_tables(tables), chunk / "file-000.parquet")
    else:
        for episode, table in enumerate(tables):
            pq.write_table(table, chunk / f"episode_{episode:06d}.parquet")
    features = {
        "observation.state": {"dtype": "float32", "shape": [4], "names": {"motors": list(SIGNALS)}},
        "action": {"dtype": "float32", "shape": [2], "names": list(ACTIONS)},
    }
    (folder / "meta").mkdir()
    information = {"codebase_version": "v3.0" if together else "v2.1", "fps": 50, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(information))


@pytest.mark.parametrize("together", [False, True])
def test_lerobot(columns, tmp_path, together):
    pairs = [f"{name}: 'observation.state[{name}]'" for name in SIGNALS]
    pairs += [f"{name}: 'action[{name}]'" for name in ACTIONS]
    robot = arm_of(tmp_path, log=f"{{columns: {{{', '.join(pairs)}}}}}")
    lerobot(tmp_path / "logs", columns, together=together)
    dataset = logs.read(tmp_path / "logs", robot)
    assert dataset.run_names == ("logs/episode_0", "logs/episode_1")
    assert dataset.episode_starts.tolist() == [0, 49]
    expected = matrix(columns, SIGNALS)[:-1].astype(np.float32)
    np.testing.assert_array_equal(dataset.transitions.observation[:49], expected)
    np.testing.assert_allclose(dataset.transitions.observation[49:], expected + 1, rtol=1e-6)


def test_lerobot_in_files_of_many_episodes_with_their_list_beside(columns, tmp_path):
    """Version 3.0 as its library writes it: lists of a fixed length, several files, a table of episodes."""
    lerobot(tmp_path / "logs", columns, together=True)
    chunk = tmp_path / "logs" / "data" / "chunk-000"
    table = pq.read_table(chunk / "file-000.parquet")
    for name, width in (("observation.state", 4), ("action", 2)):
        place = table.schema.get_field_index(name)
        table = table.set_column(place, name, table.column(name).cast(pa.list_(pa.float32(), width)))
    for file in (0, 1):  # 25 rows of the second episode are in each
        pq.write_table(table.slice(75 * file, 75 - 50 * file), chunk / f"file-{file:03d}.parquet")
    episodes = tmp_path / "logs" / "meta" / "episodes" / "chunk-000"
    episodes.mkdir(parents=True)
    pq.write_table(pa.table({"episode_index": [0, 1], "length": [50, 50]}), episodes / "file-000.parquet")
    robot = arm_of(tmp_path, log=named("observation.state", "action"))
    dataset = logs.read(tmp_path / "logs", robot)
    assert dataset.run_names == ("logs/episode_0", "logs/episode_1") and dataset.episode_starts.tolist() == [0, 49]
    expected = matrix(columns, SIGNALS)[:-1].astype(np.float32)
    np.testing.assert_allclose(dataset.transitions.observation, np.concatenate([expected, expected + 1]), rtol=1e-6)


@pytest.mark.parametrize("separator", [", ", " "])
def test_csv_with_lists_in_its_cells(columns, tmp_path, separator):
    def cells(names):
        return [f'"[{separator.join(repr(float(columns[name][row])) for name in names)}]"' for row in range(50)]

    times = map(repr, columns["time"].tolist())
    rows = zip(times, cells(SIGNALS), cells(ACTIONS), strict=True)
    file = tmp_path / "log.csv"
    file.write_text("\n".join(["time,state,action", *map(",".join, rows)]))
    robot = arm_of(tmp_path, log=named("state", "action"))
    assert_same(logs.read(file, robot), columns)
    file.write_text(file.read_text() + '\n1.0,,"[0.0 0.0]"')  # a list that is missing
    with pytest.raises(
        MadocError, match=r"as many values in every list of column 'action'.* 2 in line 52 and 3 in line 53"
    ):
        logs.read(_with(file, '\n1.02,,"[0.0 0.0 0.0]"'), robot)
    with pytest.raises(MadocError, match=r"expected a number in column 'action\[1\]' of more.csv, got 'x' in line 53"):
        logs.read(_with(file, '\n1.02,,"[0.0 x]"'), robot)


def _with(file, text):
    """The file with something behind it, beside it."""
    more = file.with_name("more.csv")
    more.write_text(file.read_text() + text)
    return more


def test_minari(columns, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    robot = arm_of(tmp_path, log=named("observations", "actions"))
    seen, done = matrix(columns, SIGNALS), matrix(columns, ACTIONS)
    flags = np.zeros(49, bool)
    buffer = minari.data_collector.EpisodeBuffer(
        observations=seen,
        actions=done[:-1],
        rewards=np.zeros(49),
        terminations=flags,
        truncations=np.append(flags[1:], True),
    )
    warnings.simplefilter("ignore")  # Minari would like an environment to go with it
    minari.create_dataset_from_buffers(
        "arm/test-v0",
        [buffer],
        observation_space=gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float64),
        action_space=gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64),
        author="a test",
        author_email="none",
        code_permalink="none",
        algorithm_name="none",
        eval_env=None,
        description="none",
    )
    dataset = logs.read(tmp_path / "minari" / "arm" / "test-v0", robot)
    assert_same(dataset, columns)
    assert dataset.findings == (
        Finding("note", "its format keeps no times: rows are taken to be 0.02 s apart", "test-v0/episode_0"),
    )


def joints_log(resample=""):
    pairs = ["shoulder: '/joints.position[hinge_1]'", "elbow: '/joints.position[hinge_2]'"]
    pairs += ["shoulder_speed: '/joints.velocity[hinge_1]'", "elbow_speed: '/joints.velocity[hinge_2]'"]
    return f"{{{resample}columns: {{{', '.join(pairs)}"


def test_mcap_of_json(columns, tmp_path):
    """Joints in another order in every second message; a topic that nothing decodes."""
    robot = arm_of(
        tmp_path,
        log=joints_log() + ", shoulder_torque: '/joints.effort[hinge_1]', elbow_torque: '/joints.effort[hinge_2]'}}",
    )
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("joints", "jsonschema", b"{}")
        channel = writer.register_channel("/joints", "json", schema)
        strange = writer.register_channel("/camera", "protobuf", 0)
        for row in range(50):
            order = [0, 1] if row % 2 else [1, 0]
            pair = lambda *names: [float([columns[name][row] for name in names][index]) for index in order]  # noqa: B023, E731
            message = {
                "name": [("hinge_1", "hinge_2")[index] for index in order],
                "position": pair("shoulder", "elbow"),
                "velocity": pair("shoulder_speed", "elbow_speed"),
                "effort": pair("shoulder_torque", "elbow_torque"),
            }
            at = 1_700_000_000_000_000_000 + row * 20_000_000
            writer.add_message(channel, at, json.dumps(message).encode(), at)
            writer.add_message(strange, at, b"\x00", at)
        writer.finish()
    assert_same(logs.read(tmp_path / "log.mcap", robot), columns)


def ros_bag(folder, columns, *, commands_every=1, storage=StoragePlugin.MCAP, version=9):
    """Joint states every row, commands on a topic of their own: the file, as `ros2 bag record` leaves it."""
    store = get_typestore(Stores.ROS2_JAZZY)
    state, time, header, torques = (
        store.types[name]
        for name in (
            "sensor_msgs/msg/JointState",
            "builtin_interfaces/msg/Time",
            "std_msgs/msg/Header",
            "std_msgs/msg/Float64MultiArray",
        )
    )
    layout = store.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    with RosWriter(folder, version=version, storage_plugin=storage) as writer:
        joints = writer.add_connection("/joints", state.__msgtype__, typestore=store)
        command = writer.add_connection("/command", torques.__msgtype__, typestore=store)
        for row in range(50):
            at, pair = row * 20_000_000, lambda *names, row=row: np.array([columns[name][row] for name in names])
            stamped, none = header(time(0, at), ""), np.zeros(0)
            message = state(
                stamped, ["hinge_1", "hinge_2"], pair("shoulder", "elbow"), pair("shoulder_speed", "elbow_speed"), none
            )
            writer.write(joints, at, store.serialize_cdr(message, state.__msgtype__))
            if row % commands_every == 0:
                message = torques(layout, pair("shoulder_torque", "elbow_torque"))
                writer.write(command, at, store.serialize_cdr(message, torques.__msgtype__))
    return next(file for file in folder.iterdir() if file.suffix in (".mcap", ".db3"))


COMMANDS = ", shoulder_torque: '/command.data[0]', elbow_torque: '/command.data[1]'}}"


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_ros_2_with_commands_of_their_own(columns, tmp_path, storage):
    """Commands change every fifth row and are only sent then: held, they are those of every row."""
    file = ros_bag(tmp_path / "bag", columns, commands_every=5, storage=storage)
    with pytest.raises(MadocError, match=r"not logged together.*ask for log: resample: hold or linear"):
        logs.read(file, arm_of(tmp_path, log=joints_log() + COMMANDS))
    robot = arm_of(tmp_path, log=joints_log("resample: hold, ") + COMMANDS)
    dataset = logs.read(tmp_path / "bag", robot)
    assert_same(dataset, columns)  # the last command holds to the end
    (note,) = dataset.findings
    assert note.level == "note"
    assert "signals held, actions held" in note.what


@pytest.mark.parametrize("definitions", ["kept", "as of before ROS 2 Iron"])
def test_a_bag_in_sqlite_by_the_stamps_of_its_messages(columns, tmp_path, definitions):
    """Bags of before Iron have no definitions; those of common types are known."""
    file = ros_bag(tmp_path / "bag", columns, storage=StoragePlugin.SQLITE3)
    with contextlib.closing(sqlite3.connect(file)) as bag:
        if definitions != "kept":
            bag.execute("DROP TABLE message_definitions")
        bag.execute("UPDATE messages SET timestamp = timestamp + 3000000 * (id % 2)")  # late in every second row
        bag.commit()
    stamped = joints_log("time: header.stamp, resample: hold, ") + COMMANDS
    with pytest.raises(MadocError, match=r"header\.stamp"):  # commands have none
        logs.read(file, arm_of(tmp_path, log=stamped))
    assert_same(logs.read(file, arm_of(tmp_path, log=joints_log("resample: hold, ") + COMMANDS)), columns)


def test_what_is_no_bag_is_named(tmp_path, columns, robot):
    file = tmp_path / "log.db3"
    file.write_bytes(b"SQLite format 3\0" + bytes(200))
    with pytest.raises(MadocError, match=r"cannot read log.db3 as a ROS 2 bag .*ros2 bag convert"):
        logs.read(file, robot)
    with contextlib.closing(sqlite3.connect(tmp_path / "other.db3")) as other:
        other.execute("CREATE TABLE songs (name TEXT)")
    with pytest.raises(MadocError, match=r"cannot read other.db3 as a ROS 2 bag .no such table: messages"):
        logs.read(tmp_path / "other.db3", robot)
    whole = ros_bag(tmp_path / "bag", columns, storage=StoragePlugin.SQLITE3)
    with contextlib.closing(sqlite3.connect(whole)) as bag:
        bag.execute("UPDATE messages SET data = x'00' WHERE id = 7")
        bag.commit()
    with pytest.raises(MadocError, match="cannot decode message 3 of /joints"):
        logs.read(whole, arm_of(tmp_path, log=joints_log("resample: hold, ") + COMMANDS))


def test_messages_of_a_type_that_nothing_defines_are_told_of(tmp_path, columns, robot):
    file = ros_bag(tmp_path / "bag", columns, storage=StoragePlugin.SQLITE3)
    with contextlib.closing(sqlite3.connect(file)) as bag:
        bag.execute("DROP TABLE message_definitions")
        bag.execute("UPDATE topics SET type = 'my_msgs/msg/Joints'")
        bag.commit()
    with pytest.raises(MadocError, match=r"expected topics of JSON or ROS 2 messages in bag.db3, got /joints"):
        logs.read(file, robot)


@pytest.mark.parametrize("how", ["hold", "linear"])
def test_another_rate_is_brought_to_ours_only_when_asked(tmp_path, how):
    """Rows 30 ms apart of signals that are linear in time: at 20 ms, the held one is that of the last row before."""
    rows = 31
    time = 0.03 * np.arange(rows)
    columns = {"time": time} | {name: 2.0 * time for name in SIGNALS} | {name: np.full(rows, 0.2) for name in ACTIONS}
    file = write_csv(tmp_path / "log.csv", columns)
    with pytest.raises(MadocError, match=r"rows 0.02 s apart in log.csv.*got 0.03 s .*resample: hold or linear"):
        logs.read(file, arm_of(tmp_path))
    dataset = logs.read(file, arm_of(tmp_path, log=f"{{resample: {how}}}"))
    grid = 0.02 * np.arange(46)
    expected = 2.0 * grid if how == "linear" else 2.0 * time[np.floor(grid / 0.03 + 1e-6).astype(int)]
    np.testing.assert_allclose(dataset.transitions.observation[:, 0], expected[:-1], rtol=0, atol=1e-12)
    assert "0.03 s apart" in dataset.findings[0].what


def test_a_gap_cuts_the_run_and_is_told(robot, columns, tmp_path):
    late = dict(columns, time=columns["time"] + 0.5 * (np.arange(50) >= 20))
    dataset = logs.read(write_csv(tmp_path / "log.csv", late), robot)
    assert dataset.episode_starts.tolist() == [0, 19]
    assert dataset.run_names == ("log.csv", "log.csv")
    assert len(dataset) == 48
    np.testing.assert_array_equal(dataset.transitions.observation[19], matrix(columns, SIGNALS)[20])
    (finding,) = dataset.findings
    assert finding.level == "warning"
    assert finding.where == "log.csv"
    assert "1 of 49 time steps" in finding.what
    assert "0.52 s before line 22" in finding.what


def test_a_row_that_is_not_finite_is_cut_with_a_word(robot, columns, tmp_path):
    holed = dict(columns, elbow=np.where(np.arange(50) == 30, np.nan, columns["elbow"]))
    dataset = logs.read(write_csv(tmp_path / "log.csv", holed), robot)
    assert dataset.episode_starts.tolist() == [0, 29]
    assert len(dataset) == 47
    assert "1 of 50 rows have NaN, infinity, more than 1e+30 or nothing in a signal or action, the first line 32" in (
        dataset.findings[0].what
    )


def test_empty_cells_are_cut_as_nan_is(robot, columns, tmp_path):
    lines = write_csv(tmp_path / "log.csv", columns).read_text().splitlines()
    lines[10] = lines[10].rsplit(",", 1)[0] + ","
    (tmp_path / "log.csv").write_text("\n".join(lines))
    dataset = logs.read(tmp_path / "log.csv", robot)
    assert dataset.episode_starts.tolist() == [0, 9]  # the row's signals are known: row 8 leads to them
    assert len(dataset) == 48
    assert "line 11" in dataset.findings[0].what


def test_clipping_is_asked_for(robot, columns, tmp_path):
    strong = dict(columns, shoulder_torque=columns["shoulder_torque"] * 3.0)
    dataset = logs.read(write_csv(tmp_path / "log.csv", strong), robot, clip_actions=True)
    expected = np.clip(strong["shoulder_torque"][:-1] / 0.5, -1.0, 1.0)
    np.testing.assert_allclose(dataset.transitions.action[:, 0], expected, rtol=0, atol=1e-12)


def test_a_folder_is_a_run_a_file(robot, columns, tmp_path):
    for shift, name in enumerate(("b.csv", "a/c.csv", ".hidden/d.csv"), 1):
        write_csv(tmp_path / "logs" / name, columns | {"elbow": columns["elbow"] + shift})
    (tmp_path / "logs" / "README.txt").write_text("recorded on a Monday")
    (tmp_path / "logs" / "old.bag").write_bytes(b"#ROSBAG")
    np.savez(tmp_path / "logs" / "z.npz", **columns)
    dataset = logs.read(tmp_path / "logs", robot)
    assert dataset.run_names == ("a/c.csv", "b.csv", "z.npz")
    assert dataset.findings == (Finding("note", "old.bag were not read: no reader knows them", str(tmp_path / "logs")),)
    several = logs.read([tmp_path / "logs" / "b.csv", tmp_path / "logs" / "a" / "c.csv"], robot)
    assert several.run_names == ("b.csv", "c.csv")
    assert len(several) == 2 * 49


def test_a_run_folder_among_the_logs_is_no_log(robot, columns, tmp_path):
    write_csv(tmp_path / "run.csv", columns)
    for name in ("spec.json", "result.json", "export/table.csv", "evidence.npz"):
        (tmp_path / "calibrated" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "calibrated" / name).write_text("{}")
    assert logs.read(tmp_path, robot).run_names == ("run.csv",)


def test_a_zip_archive_of_other_files_is_refused(robot, tmp_path):
    with zipfile.ZipFile(tmp_path / "log.npz", "w") as archive:
        archive.writestr("method.json", "{}")
    with pytest.raises(MadocError, match=r"only arrays in .*log.npz, got the file 'method.json'"):
        logs.read(tmp_path / "log.npz", robot)


@pytest.mark.parametrize(
    ("reader", "package", "file"),
    [(parquet_reader, "pyarrow", "log.parquet"), (mcap_reader, "mcap.reader", "log.mcap")],
)
def test_a_missing_extra_names_its_command(tmp_path, monkeypatch, reader, package, file):
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / file).write_bytes(b"anything")
    with pytest.raises(MadocError, match=r'pip install "madoc-calibration\[logs\]"'):
        reader.read(tmp_path / file, ())


def test_ros_2_without_its_library_names_the_extra(columns, tmp_path, robot, monkeypatch):
    file = ros_bag(tmp_path / "bag", columns, storage=StoragePlugin.SQLITE3)
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(MadocError, match=r'ROS 2 messages, which need: pip install "madoc-calibration\[logs\]"'):
        logs.read(file, robot)
