"""Logs of messages, MCAP and bags of ROS 2, written here and read back to the same numbers."""

import contextlib
import json
import sqlite3
import sys

import numpy as np
import pytest
from logged_arm import arm_of, assert_same
from mcap.writer import Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosWriter
from rosbags.typesys import Stores, get_typestore

from madoc.data import logs
from madoc.errors import MadocError


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


def test_ros_2_without_its_library_names_the_extra(columns, tmp_path, robot, monkeypatch):
    file = ros_bag(tmp_path / "bag", columns, storage=StoragePlugin.SQLITE3)
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(MadocError, match=r'ROS 2 messages, which need: pip install "madoc-calibration\[logs\]"'):
        logs.read(file, robot)
