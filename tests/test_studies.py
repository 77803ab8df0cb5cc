"""Tables of results: appended whole by several processes, read as what they are, never pooled over methods or seeds."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import kept
import pooling

import calibration
from madoc import simulation, tasks
from madoc.identification.states import states_of


@pytest.fixture
def study(tmp_path):
    return kept.Study(tmp_path / "study.jsonl", ("method", "seed"))


def test_a_row_says_what_was_asked_and_where_without_a_host_or_a_path(study):
    study.add({"method": "a", "seed": 0})
    (row,) = study.rows()
    assert {*row["versions"]} == {"python", *kept.VERSIONED}
    assert re.fullmatch(r"[0-9a-f]{7,}\+?", row["commit"])
    assert re.match(r"\d+ cores?, ", row["machine"])
    assert "/" not in json.dumps(row)


def test_a_line_that_was_cut_off_is_taken_away(study):
    study.add({"method": "a", "seed": 0})
    with study.file.open("a") as stream:
        stream.write('{"method": "b", "se')
    assert [row["method"] for row in study.rows()] == ["a"]
    study.add({"method": "c", "seed": 0})
    assert [row["method"] for row in study.every()] == ["a", "c"]


def test_the_last_row_of_a_cell_counts_and_gone_methods_are_not_shown(study):
    for row in ({"error": 1}, {"error": 2, "commit": "x"}, {"method": "old", "gone": "why"}):
        study.add({"method": "a", "seed": 0} | row)
    assert [row["error"] for row in study.rows()] == [2]
    assert len(study.every()) == 3
    assert study.has({"method": "a", "seed": 0})
    assert study.has({"method": "a", "seed": 0}, "x")
    assert not study.has({"method": "a", "seed": 0}, "y")
    assert not study.has({"method": "old", "seed": 0})


APPEND = """
import sys
from pathlib import Path
import kept
kept.stamp = dict
study = kept.Study(Path(sys.argv[1]), ("method", "seed"))
for seed in range(50):
    study.add({"method": sys.argv[2], "seed": seed, "bulk": "x" * 100_000})
"""


def test_processes_that_append_at_once_leave_whole_rows(study):
    words = [sys.executable, "-c", APPEND, str(study.file)]
    place = Path(kept.__file__).parent
    workers = [subprocess.Popen([*words, worker], cwd=place) for worker in ("a", "b", "c")]
    assert [worker.wait() for worker in workers] == [0, 0, 0]
    assert len(study.rows()) == 150


def test_a_cell_that_another_process_runs_is_not_run(study):
    cell = {"method": "a", "seed": 0}
    with study.claimed(cell) as first, study.claimed(cell) as second, study.claimed(cell | {"seed": 1}) as other:
        assert (first, second, other) == (True, False, True)
        study.add(cell)
    with study.claimed(cell) as again, study.claimed(cell, "another commit") as anew:
        assert not again
        assert not anew  # it is claimed above
    with study.claimed(cell, "another commit") as anew:
        assert anew


def row(method="madoc", log=0, error=1.0, **other):
    asked = {"robot": "hopper", "quality": "medium", "data": "clean", "transitions": 10, "method": method, "log": log}
    return asked | {"budget": 300_000, "error": {"mean_absolute": error}, "commit": "a"} | other


def test_seeds_of_a_log_are_averaged_before_logs_are():
    found = pooling.by_log(
        [row(error=1.0), row(error=3.0, seed=1), row(log=1, error=8.0), row(log=2) | {"error": {"mean_absolute": 4.0}}]
    )
    assert sorted(found.values()) == [2.0, 4.0, 8.0]
    assert pooling.shown(found) == "4.7 (2 to 8)"


@pytest.mark.parametrize(
    "other", [{"method": "droid"}, {"set": ["group_count=2"]}, {"calibrated": ["gravity"]}, {"budget": "60s"}]
)
def test_different_methods_share_no_mean(other):
    with pytest.raises(pooling.MixedError, match="share no mean"):
        pooling.by_log([row(), row(log=1) | other])


def test_ratios_have_intervals_over_logs():
    ours = pooling.by_log([row(log=log, error=error) for log, error in enumerate((1.0, 2.0, 4.0, 3.0))])
    theirs = pooling.by_log(
        [row("droid", log=log, error=error, seed=seed) for log, error in enumerate((2.0, 2.0, 2.0)) for seed in (0, 1)]
    )
    assert (
        pooling.ratio(ours, theirs) == "1.00 (0.18 to 5.59, 3 logs)"
    )  # ratios 1/2, 1 and 2: t of 2 degrees, 4.3 ln 2 / √3
    assert pooling.ratio({}, theirs) == ""


def test_rows_of_several_commits_say_so():
    assert kept.commits([row(), row()]) == "a"
    assert kept.commits([row(), row(commit="b")]) == "mixed: a, b"


@pytest.mark.parametrize("robot", tasks.TASKS)
def test_logs_have_truths_of_their_own_in_the_middle_of_the_ranges(robot):
    task = tasks.make(robot, "legacy")
    space = task.parameters
    truths = np.array([list(calibration.planted_truth(task, "medium", log).values()) for log in range(1, 200)])
    share = (truths - space.low) / (space.high - space.low)
    assert 0.1 <= share.min() < 0.15
    assert 0.85 < share.max() <= 0.9
    assert (truths[:, [row.field == "body_mass" for row in space.parameters]] > 0).all()
    assert len(np.unique(truths[:, 0])) == len(truths)


def test_undeclared_noise_is_in_the_log_and_not_declared(tmp_path):
    task = tasks.make("hopper", "legacy")
    logs = {
        kind: calibration.recorded(task, "medium", 200, tmp_path, data_is=kind, log=1)
        for kind in ("clean", "noise-10", "noise-10-undeclared")
    }
    _, shown = calibration.KINDS["noise-10-undeclared"].view(task, logs["noise-10-undeclared"])
    assert logs["noise-10"].disturbance.noise == 0.1
    assert shown.disturbance.noise == 0.0
    seen = {kind: np.asarray(each.transitions.observation) for kind, each in logs.items()}
    assert (seen["noise-10"] == np.asarray(shown.transitions.observation)).all()
    assert (seen["noise-10"] != seen["clean"]).any()


def test_a_cell_is_run_once_and_kept_beside_mid_range(tmp_path, monkeypatch, capsys):
    results = tmp_path / "calibration.jsonl"
    words = ["--tasks", "hopper-medium", "--methods", "nominal", "droid", "--logs", "1", "--data-is", "shuffled-next"]
    words += ["--transitions", "200", "--folder", str(tmp_path), "--results", str(results), "--threads", "1"]
    for _ in range(2):
        monkeypatch.setattr(sys, "argv", ["calibration.py", *words])
        calibration.main()
    nominal, refused = [json.loads(line) for line in results.read_text().splitlines()]
    assert nominal["error"]["mean_absolute"] == nominal["mid_range"]["mean_absolute"]
    assert nominal["truth"] == calibration.planted_truth(tasks.make("hopper", "legacy"), "medium", 1)
    assert (nominal["log"], nominal["seed"], nominal["budget"]) == (1, 1, 300_000)
    assert "shuffled" in refused["refusal"]
    assert len(capsys.readouterr().out.splitlines()) == 2


@pytest.mark.parametrize(("robot", "shown", "first"), [("hopper", 8, 1), ("ant", 23, 1)])
def test_encoders_and_an_imu_show_neither_height_nor_linear_velocity(robot, shown, first, tmp_path):
    task = tasks.make(robot, "legacy")
    whole = calibration.recorded(task, "medium", 100, tmp_path, data_is="encoders", log=1)
    seen, log = calibration.KINDS["encoders"].view(task, whole)
    rows, every = log.transitions.observation, np.asarray(whole.transitions.observation)
    assert seen.observation_size == rows.shape[1] == shown
    assert (rows[:, 0] == every[:, first]).all()  # the attitude comes first, the height is gone
    assert states_of(log, simulation.make(seen)).kind == "unknown"
