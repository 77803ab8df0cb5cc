"""Tables of a log put together: rates, gaps, rows that are no numbers, actions out of range, folders of runs."""

import numpy as np
import pytest
from logged_arm import ACTIONS, SIGNALS, arm_of, matrix, write_csv

from madoc.data import logs
from madoc.data.findings import Finding
from madoc.errors import MadocError


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
