"""Inputs of a robot of one's own that are wrong: one sentence each, exit code 2, nothing written."""

import sys
from pathlib import Path

import numpy as np
import pytest

from madoc.commands.main import main
from robots import ARM

sys.path.append(str(Path(__file__).parents[1] / "data"))
from logged_arm import SPEC, arm_of, columns_of, write_csv


@pytest.fixture(scope="module")
def columns(tmp_path_factory):
    return columns_of(arm_of(tmp_path_factory.mktemp("good")), 60)


def spec(before, after):
    """The spec with a part replaced."""

    def write(folder, columns):
        assert before in SPEC
        (folder / "arm.yaml").write_text(SPEC.replace(before, after, 1))

    return write


def model(before, after):
    """The model with a part replaced."""

    def write(folder, columns):
        assert before in ARM
        (folder / "arm.xml").write_text(ARM.replace(before, after, 1))

    return write


def raw(name, content):
    """A file of its own content; the only log, if it is one."""

    def write(folder, columns):
        if name not in ("arm.yaml", "arm.xml"):
            (folder / "logs" / "0.csv").unlink()
        (folder / name).write_bytes(content)

    return write


def log(**changes):
    """The log with columns changed, or left out where None; a pair is (row, value)."""

    def write(folder, columns):
        table = {name: values.copy() for name, values in columns.items() if changes.get(name, 0) is not None}
        for name, (row, value) in ((name, pair) for name, pair in changes.items() if pair is not None):
            table[name][row] = value
        write_csv(folder / "logs" / "0.csv", table)

    return write


def lines(change):
    """The lines of the log, changed."""

    def write(folder, columns):
        file = folder / "logs" / "0.csv"
        file.write_text("\n".join(change(file.read_text().splitlines())) + "\n")

    return write


def none(folder, columns):
    """A folder without logs."""
    (folder / "logs" / "0.csv").unlink()


MALFORMED = {
    # Specs.
    "no file": (lambda folder, columns: (folder / "arm.yaml").unlink(), "arm.yaml"),
    "an empty spec": (raw("arm.yaml", b""), "is empty; write one with: madoc init MODEL"),
    "no YAML": (raw("arm.yaml", b"madoc: [1"), "this is not YAML"),
    "a spec of bytes": (raw("arm.yaml", b"\xff\xfe\x00"), "expected text in UTF-8"),
    "a tag": (raw("arm.yaml", b"madoc: !!python/object:os.system 1\n"), "expected a plain value"),
    "another version": (spec("madoc: 1", "madoc: 7"), "expected 1 in madoc, got 7"),
    "an unknown key": (spec("control_step:", "control_stp:"), "unknown key 'control_stp'; nearest: control_step"),
    "a key twice": (spec("madoc: 1", "madoc: 1\nname: a"), "'name' is given twice"),
    "a control step of no whole steps": (spec("0.02", "0.025"), "a whole multiple of the timestep 0.01 s"),
    "a negative control step": (spec("0.02", "-0.02"), "expected greater than or equal to 0.000001 in control_step"),
    "a joint the model lacks": (spec("position(elbow)", "position(elbo)"), "no joint 'elbo'; nearest: elbow"),
    "an expression cut short": (spec("position(elbow)", "position(elbow"), "does not parse"),
    "an expression that would run code": (spec("position(elbow)", "__import__('os')"), "arm.yaml, line 7: "),
    "a unit that is not the model's": (spec("{name: elbow, reads", "{name: elbow, unit: deg, reads"), "in rad"),
    "an actuator the model lacks": (spec("actuator: elbow", "actuator: elbw"), "nearest: elbow"),
    "a range upside down": (spec("low: 0.5, high: 2.0", "low: 2.0, high: 0.5"), "low < high"),
    "a field nobody knows": (spec("field: body_mass", "field: body_mas"), "nearest: body_mass"),
    "a mass below zero": (spec("low: 0.5, high: 2.0", "low: -0.5, high: 2.0"), "below its physical bound"),
    "a parameter twice": (spec("element: fore", "element: upper"), "on line 14 already"),
    "an empty parameter": (spec("{field: body_mass, element: upper, low: 0.5, high: 2.0}", "{}"), "expected"),
    "gravity that may point up": (
        spec("parameters:", "parameters:\n  - {field: gravity, low: -11, high: 11}"),
        "line 14: gravity is negative where it points down, got a range up to 11",
    ),
    "the number of a gear that is not there": (
        spec("parameters:", "parameters:\n  - {field: gear_stiffness, element: elbow, low: 1, high: 2}"),
        "line 14: gear_stiffness: joint 'elbow' has no gear; say it under gears:",
    ),
    "a decimal comma": (spec("low: 0.5,", "low: 0,5,"), "line 14: expected a word before the colon, got 5; write 0.5"),
    "a tab": (
        spec("  - {field: body_mass, element: fore", "\t- {field: body_mass, element: fore"),
        "indent with spaces",
    ),
    "no signals": (spec("signals:", "signal:"), "unknown key 'signal'; nearest: signals"),
    # Models.
    "no model": (lambda folder, columns: (folder / "arm.xml").unlink(), "there is no model file"),
    "an empty model": (raw("arm.xml", b""), "cannot be read"),
    "a model that is no XML": (raw("arm.xml", b"hello"), "cannot be read"),
    "a xacro file": (model("<worldbody>", "<xacro:arm/><worldbody>"), "has xacro macros; expand them first"),
    "an element MuJoCo lacks": (model("<worldbody>", "<wordbody/><worldbody>"), "wordbody"),
    "a model without mass": (model('mass="0.5"', 'mass="0"'), "does not compile"),
    "a motor of no joint": (model('joint="elbow" gear', 'joint="knee" gear'), "unknown transmission target 'knee'"),
    "an included file that is missing": (model("</mujoco>", '<include file="hand.xml"/></mujoco>'), "hand.xml"),
    # Logs.
    "no log": (none, "expected logs in the folder"),
    "an empty log": (raw("logs/1.csv", b""), "is empty"),
    "a header alone": (lines(lambda rows: rows[:1]), "expected rows below the header"),
    "one row": (lines(lambda rows: rows[:2]), "at least two rows"),
    "no header": (lines(lambda rows: rows[1:]), "expected the names of the columns in the first line"),
    "a column missing": (log(elbow=None), "no column 'elbow' in 0.csv; nearest:"),
    "no time": (log(time=None), "no column 'time'"),
    "a column twice": (lines(lambda rows: [rows[0].replace("elbow_speed", "elbow"), *rows[1:]]), "'elbow' twice"),
    "a word among numbers": (lines(lambda rows: [*rows[:9], "a" + rows[9], *rows[10:]]), "expected a number"),
    "a row of units": (
        lines(lambda rows: [rows[0], ",".join("s" for _ in rows[0].split(",")), *rows[1:]]),
        "a row of units",
    ),
    "a line cut short": (lines(lambda rows: [*rows[:-1], rows[-1][:9]]), "cells in every line"),
    "time that goes back": (log(time=(40, 0.0)), "time to go forward"),
    "time in milliseconds": (log(time=(slice(None), 20.0 * np.arange(60))), "is it in ms?"),
    "an action out of its range": (log(elbow_torque=(3, 0.9)), "within its range of [0, 0.4] N·m, got 0.9"),
    "hardly a reading that can be meant": (log(elbow=(slice(0, 50), 1e200)), "got NaN, infinity, more than 1e+30"),
    "hardly a finite row": (log(elbow=(slice(0, 50), np.nan)), "got NaN, infinity, more than 1e+30 or nothing"),
    "nothing ever moves": (
        log(**dict.fromkeys(("shoulder", "elbow", "shoulder_speed", "elbow_speed"), (slice(None), 0.0))),
        "it never moves: 0 in all 59 rows",
    ),
    "an npz cut short": (raw("logs/1.npz", b"PK\x03\x04 and no more"), "1.npz"),
    "a kind of file no reader knows": (raw("logs/1.bag", b"#ROSBAG"), "expected logs in the folder logs"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_one_sentence_and_nothing_written(name, columns, tmp_path, monkeypatch, capsys):
    spoil, words = MALFORMED[name]
    arm_of(tmp_path)
    write_csv(tmp_path / "logs" / "0.csv", columns)
    spoil(tmp_path, columns)
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    assert main(["calibrate", "arm.yaml", "--data", "logs", "--quiet"]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("madoc: ")
    assert told.err.count("\n") == 1
    assert words in told.err
    assert sorted(tmp_path.rglob("*")) == before
