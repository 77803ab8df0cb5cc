import json
import shutil
import signal
import time

import pytest
from command_line import CALIBRATION, WHOLE, WHOLE_CODE, asked_for_json, start, without_seconds

from madoc.commands.answer import EXIT_CODES
from madoc.commands.main import main


def summary_of(folder):
    return without_seconds(json.loads((folder / "summary.json").read_text()))


def wait_for(place, process):
    """Wait until a file is there: a signal then falls into the stage after it."""
    for _ in range(12_000):
        if place.exists():
            return
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    raise AssertionError(f"no {place} for two minutes")


def test_a_run_leaves_everything(whole):
    found = {file.name for file in whole.iterdir()} - {".lock"}
    policies = {"policy-calibrated", "policy-midrange", "policy-truth"}
    files = {"data.npz", "evaluation.json", "film.npz", "film.webp", "summary.json", "spec.json", "report.html"}
    assert found == files | {"calibration", "export"} | policies
    assert all((whole / name / "policy.npz").exists() for name in policies)
    summary = summary_of(whole)
    assert summary["status"] == "finished"
    assert list(summary["evaluation"]["policies"]) == ["calibrated", "midrange", "truth"]
    assert summary["calibration"]["verdict"]["word"] == "NO_IMPROVEMENT"
    assert summary["evaluation"]["over_draws"]["midrange"]["draws"] == 4
    assert list(summary["evaluation"]["error_costs"]) == ["calibrated"]
    assert set(summary["evaluation"]["error_costs"]["calibrated"]) == set(summary["calibration"]["parameters"])
    assert summary["data"]["transitions"] == 500


def test_the_log_of_a_calibration_has_the_estimates_on_their_way(whole):
    lines = [json.loads(line) for line in (whole / "calibration" / "metrics.jsonl").read_text().splitlines()]
    assert lines[0]["metrics"]["estimate/gravity"] == pytest.approx(-15.0, abs=0.01)
    last = json.loads((whole / "calibration" / "result.json").read_text())["parameters"]
    for name, row in last.items():
        assert lines[-1]["metrics"][f"estimate/{name}"] == row["estimate"]
        assert lines[-1]["metrics"][f"std/{name}"] == row["std"]


def test_resuming_a_finished_run_only_reads_it(whole, capsys):
    before = {file: file.stat().st_mtime_ns for file in whole.rglob("*.npz")}
    answer, code = asked_for_json(capsys, [*WHOLE, "--out", whole, "--resume"])
    assert code == WHOLE_CODE
    assert without_seconds(answer) == summary_of(whole)
    assert {file: file.stat().st_mtime_ns for file in whole.rglob("*.npz")} == before


def test_resuming_does_only_what_is_missing(whole, tmp_path, capsys):
    copy = tmp_path / "run"
    shutil.copytree(whole, copy)
    (copy / "summary.json").unlink()
    (copy / "policy-midrange" / "policy.npz").unlink()
    shutil.rmtree(copy / "policy-truth")
    answer, _ = asked_for_json(capsys, [*WHOLE, "--out", copy, "--resume"])
    assert summary_of(copy) == summary_of(whole)
    earlier = json.loads((whole / "summary.json").read_text())
    assert answer["calibration"]["seconds"] == earlier["calibration"]["seconds"]


@pytest.mark.slow
def test_a_log_without_truth_is_calibrated_and_learnt_from(recorded, tmp_path, capsys):
    import numpy as np

    log, out = tmp_path / "log.npz", tmp_path / "run"
    with np.load(recorded) as arrays:
        columns = dict(arrays)
    metadata = json.loads(str(columns["metadata"])) | {"true_parameters": None}
    np.savez(log, **columns | {"metadata": np.array(json.dumps(metadata))})
    answer, code = asked_for_json(capsys, ["run", "hopper", "--data", log, *WHOLE[2:], "--out", out])
    assert code == EXIT_CODES[answer["calibration"]["verdict"]["word"]]
    assert answer["evaluation"]["policies"] == {}
    assert list(answer["evaluation"]["at_estimate"]) == ["calibrated"]
    assert "error" not in answer["calibration"]
    assert list(answer["policies"]) == ["calibrated"]
    assert "the target's parameters are not known" in answer["sentence"]


def test_a_policy_learnt_from_a_log_is_evaluated_at_the_truth_that_the_log_carries(recorded, tmp_path, capsys):
    words = ["run", "hopper", "--data", recorded, *WHOLE[2:], "--no-yardsticks", "--out", tmp_path / "run"]
    answer, code = asked_for_json(capsys, words)
    assert code == EXIT_CODES[answer["calibration"]["verdict"]["word"]]
    assert list(answer["evaluation"]["policies"]) == ["calibrated"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "moment",
    [
        "spec.json",
        "data.npz",
        "calibration/metrics.jsonl",
        "calibration/result.json",
        "policy-calibrated/metrics.jsonl",
        "policy-midrange/policy.npz",
        "policy-truth/result.json",
        "evaluation.json",
    ],
)
def test_a_killed_run_resumes_to_the_same_summary(moment, whole, tmp_path):
    out = tmp_path / "run"
    process = start([*WHOLE, "--out", out])
    wait_for(out / moment, process)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert main([*WHOLE, "--out", str(out), "--resume"]) == WHOLE_CODE
    assert summary_of(out) == summary_of(whole)


@pytest.mark.slow
def test_ctrl_c_leaves_a_usable_folder(whole, recorded, tmp_path, capsys):
    out = tmp_path / "calibration"
    words = ["calibrate", "hopper", "--data", recorded, "--out", out, *CALIBRATION, "--budget", "1000000"]
    process = start(words)
    wait_for(out / "metrics.jsonl", process)
    process.send_signal(signal.SIGINT)
    told, complaints = process.communicate(timeout=60)
    assert process.returncode == 130, complaints
    assert "interrupted at" in told
    assert json.loads((out / "result.json").read_text())["status"] == "interrupted"
    answer, code = asked_for_json(capsys, [*words[:-1], "2000", "--resume"])
    assert code == 0
    assert answer["status"] == "finished"
