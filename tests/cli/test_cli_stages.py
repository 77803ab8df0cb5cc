import json
import shutil
import signal
import time

import numpy as np
import pytest
from command_line import CALIBRATION, LEARNING, WHOLE, WHOLE_CODE, asked_for_json, start, without_seconds

from madoc.calibration import CalibrationResult
from madoc.commands.answer import EXIT_CODES
from madoc.commands.main import main
from madoc.data.targets import paper_truth
from madoc.numpy_policy import NumpyPolicy

RESULT = {
    *("method", "task", "status", "sentence", "control_steps", "seconds", "seed", "groups", "parameters", "settled"),
    *("warnings", "error", "unlike_noise"),
}


def read(path):
    return json.loads(path.read_text())


@pytest.mark.slow
def test_calibrate_prints_what_it_leaves(recorded, whole, tmp_path, capsys):
    out = tmp_path / "calibration"
    words = ["calibrate", "hopper", "--data", recorded, "--out", out, *CALIBRATION, "--holdout", "0.2"]
    answer, code = asked_for_json(capsys, words)
    assert code == EXIT_CODES[answer["verdict"]["word"]]
    assert answer == read(out / "result.json")
    assert answer.keys() == RESULT | {"verdict", "holdout", "combinations"}
    assert CalibrationResult.from_json(answer).to_json() == answer
    spec = read(out / "spec.json")
    assert spec["hyperparameters"]["agents"]["batch"] == 32
    assert spec["data"]["rows"] == 500
    # Alone it does the same as within `madoc run`.
    assert without_seconds(answer) == without_seconds(read(whole / "calibration" / "result.json"))
    again, same = asked_for_json(capsys, [*words, "--resume"])
    assert (again, same) == (answer, code)


def test_calibrate_some_parameters_with_a_truth_of_ones_own(recorded, tmp_path, capsys):
    names = ["gravity", "body_mass.foot"]
    truth = tmp_path / "truth.json"
    truth.write_text(json.dumps(paper_truth("hopper") | {"gravity": -15.0}))
    words = ["calibrate", "hopper", "--data", recorded, "--parameters", *names, "--truth", truth, *CALIBRATION]
    answer, _ = asked_for_json(capsys, [*words, "--out", tmp_path / "run"])
    assert list(answer["parameters"]) == names
    estimate = answer["parameters"]["gravity"]["estimate"]
    assert answer["error"]["per_parameter"]["gravity"] == pytest.approx(abs(estimate + 15.0))


def test_the_table_of_a_calibration(recorded, tmp_path, capsys):
    words = ["calibrate", "hopper", "--data", recorded, "--out", tmp_path / "run", *CALIBRATION]
    assert main([str(word) for word in words]) == 0
    told = capsys.readouterr().out
    assert "body_mass.torso" in told
    assert "mean absolute error" in told
    assert f"run folder: {tmp_path / 'run'}" in told


def test_learn_from_a_result_file_and_evaluate_the_policy_alone(whole, tmp_path, capsys):
    file, out = whole / "calibration" / "result.json", tmp_path / "policy"
    answer, code = asked_for_json(
        capsys, ["learn", file, "--method", "sac-bc", "--at", "midrange", "--out", out, *LEARNING]
    )
    assert (answer["status"], answer["control_steps"], code) == ("finished", 1000, 0)
    action = NumpyPolicy.load(answer["policy"]).act(np.zeros((5, 11)))
    assert action.shape == (5, 3)
    evaluation, code = asked_for_json(capsys, ["evaluate", out, "--episodes", 1, "--quiet"])
    assert (list(evaluation["policies"]), code) == (["policy"], 0)
    assert evaluation == read(out / "evaluation.json")


def test_a_bare_result_has_no_data_to_clone(whole, tmp_path, capsys):
    file = tmp_path / "result.json"
    shutil.copy(whole / "calibration" / "result.json", file)
    assert main(["learn", str(file), "--method", "sac-bc"]) == 2
    assert "names no data" in capsys.readouterr().err
    assert main(["learn", str(file), "--at", "truth"]) == 2
    assert "pass --truth" in capsys.readouterr().err


def test_a_run_folder_can_be_moved(whole, tmp_path, capsys):
    moved = tmp_path / "elsewhere"
    shutil.copytree(whole, moved)
    words = ["learn", moved, "--method", "sac-bc", *LEARNING]
    answer, _ = asked_for_json(capsys, words)
    assert answer["policy"] == str(moved / "policy-calibrated-sac-bc" / "policy.npz")
    evaluation, _ = asked_for_json(capsys, ["evaluate", moved, "--episodes", 1, "--quiet"])
    assert list(evaluation["policies"]) == ["calibrated", "calibrated-sac-bc", "midrange", "truth"]


def test_evaluate_shows_policies_beside_the_yardsticks(whole, tmp_path, capsys):
    copy = tmp_path / "run"
    shutil.copytree(whole, copy)
    assert main(["evaluate", str(copy), "--episodes", "2", "--draws", "4", "--quiet"]) == 0
    told = capsys.readouterr().out
    assert "at the calibrated parameters" in told
    assert "at the truth (yardstick)" in told
    assert "% of the return of the policy learnt at the truth" in told
    # The same episodes as `madoc run` saw.
    assert read(copy / "evaluation.json") == read(whole / "evaluation.json")


@pytest.mark.parametrize("at", ["distribution", "uniform"])
def test_learn_over_a_distribution(whole, tmp_path, capsys, at):
    words = [
        "learn",
        whole / "calibration" / "result.json",
        "--method",
        "sac",
        "--at",
        at,
        "--out",
        tmp_path / "policy",
        *LEARNING,
    ]
    answer, code = asked_for_json(capsys, words)
    assert (answer["at"], answer["spent"], answer["budget_unit"], code) == (at, 1000, "control steps", 0)


def test_learn_from_the_data_alone(whole, tmp_path, capsys):
    moved = tmp_path / "run"
    shutil.copytree(whole, moved)
    words = ["learn", moved, "--method", "bc", "--budget", "20", "--quiet", "--set", "epoch_updates=10", "batch=32"]
    answer, code = asked_for_json(capsys, words)
    assert (answer["spent"], answer["budget_unit"], answer["control_steps"], code) == (20, "updates", 0, 0)
    assert answer["policy"] == str(moved / "policy-bc" / "policy.npz")
    lines = [json.loads(line) for line in (moved / "policy-bc" / "metrics.jsonl").read_text().splitlines()]
    assert [line["updates"] for line in lines] == [10, 20]
    assert read(moved / "policy-bc" / "result.json")["updates"] == 20


def test_a_log_that_has_changed_since_the_calibration_is_not_learnt_from(whole, tmp_path, capsys):
    moved = tmp_path / "run"
    shutil.copytree(whole, moved)
    with np.load(moved / "data.npz") as archive:
        arrays = dict(archive)
    arrays["observation"] = arrays["observation"] + 1.0
    np.savez(moved / "data.npz", **arrays)
    assert main(["learn", str(moved), "--method", "bc", "--budget", "20"]) == 2
    assert "has changed since the calibration" in capsys.readouterr().err
    assert not (moved / "policy-bc").exists()


@pytest.mark.parametrize("method", ["bc", "cql", "morec", "dr-bc"])
def test_a_place_that_would_change_nothing_is_refused(whole, capsys, method):
    assert main(["learn", str(whole), "--method", method, "--at", "midrange"]) == 2
    assert f"{method} does not learn at given parameters" in capsys.readouterr().err


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


@pytest.mark.slow
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
