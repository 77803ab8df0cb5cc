import json
import shutil

import numpy as np
import pytest
from command_line import CALIBRATION, LEARNING, asked_for_json, without_seconds

from madoc.calibration import CalibrationResult
from madoc.commands.answer import EXIT_CODES
from madoc.commands.main import main
from madoc.data.targets import paper_truth
from madoc.numpy_policy import NumpyPolicy

RESULT = {
    *("method", "task", "status", "sentence", "control_steps", "seconds", "seed", "groups", "parameters", "settled"),
    *("warnings", "error", "long_tails"),
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
