import json
import sys
from pathlib import Path

import pytest
from command_line import asked_for_json

from madoc import data, tasks
from madoc.commands.main import main
from madoc.data.targets import paper_truth

sys.path.append(str(Path(__file__).parents[1] / "data"))
from logged_arm import arm_of, columns_of, write_csv


def test_a_recording_says_what_it_is(tmp_path, capsys):
    out = tmp_path / "log.npz"
    words = ["record", "hopper-medium-expert", "--transitions", 300, "--seed", 3, "--quiet", "--out", out]
    answer, code = asked_for_json(capsys, words)
    assert code == 0
    dataset = data.load(out, tasks.hopper())
    assert len(dataset) == answer["transitions"] == 300
    assert answer["episodes"] == len(dataset.episode_starts)
    assert dataset.true_parameters == answer["true_parameters"] == paper_truth("hopper")
    assert answer["mean_return"] == pytest.approx(dataset.transitions.reward.sum() / answer["episodes"])


def test_a_recording_says_how_it_was_disturbed(tmp_path, capsys):
    out = tmp_path / "log.npz"
    words = ["record", "hopper-medium", "--transitions", 300, "--quiet", "--out", out]
    words += ["--noise", 0.1, "--hide-velocities", "--shuffle", "rows", "--friction", 1.2, "--physics", "modern"]
    answer, code = asked_for_json(capsys, words)
    assert code == 0
    dataset = data.load(out, tasks.hopper())
    assert dataset.disturbance == data.Disturbance(**answer["disturbance"])
    assert dataset.disturbance == data.Disturbance(0.1, True, "rows", 1.2)
    assert dataset.physics == "modern"
    assert dataset.transitions.observation.shape == (300, 5)


def test_data_disturbed_by_the_reader_is_told_in_the_result(tmp_path, capsys):
    log, out = tmp_path / "log.npz", tmp_path / "run"
    assert main(["record", "hopper-medium", "--transitions", "300", "--quiet", "--out", str(log)]) == 0
    capsys.readouterr()
    words = ["calibrate", "hopper", "--data", log, "--out", out, "--quiet", "--noise", 0.01]
    words += ["--method", "least-squares", "--set", "windows=50", "search_windows=20", "searches=1", "--budget", 4000]
    answer, code = asked_for_json(capsys, words)
    assert code == 0
    assert any("observation noise of 1 %" in warning for warning in answer["warnings"])
    assert answer["parameters"]["gravity"]["interval"][0] < answer["parameters"]["gravity"]["estimate"]
    assert len(answer["covariance"]) == 8
    again, _ = asked_for_json(capsys, [*words, "--resume"])
    assert again == answer


def test_a_recording_does_not_write_over_a_file(tmp_path, capsys):
    out = tmp_path / "log.npz"
    out.write_text("mine")
    words = ["record", "hopper-medium", "--transitions", "200", "--quiet", "--out", str(out)]
    assert main(words) == 2
    assert "--force" in capsys.readouterr().err
    assert out.read_text() == "mine"
    assert main([*words, "--force"]) == 0
    assert len(data.load(out, tasks.hopper())) == 200


def test_progress_goes_to_standard_error(tmp_path, capsys):
    assert main(["record", "hopper-medium", "--transitions", "200", "--out", str(tmp_path / "log.npz")]) == 0
    told = capsys.readouterr()
    assert "transitions/s" in told.err
    assert "transitions/s" not in told.out


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arm")
    robot = arm_of(folder)
    for seed in (0, 1):
        write_csv(folder / "logs" / f"{seed}.csv", columns_of(robot, 150, seed=seed))
    return folder


def test_tables_to_read(arm, capsys):
    assert main(["check", str(arm / "arm.yaml"), "--data", str(arm / "logs"), "--no-forecast"]) == 0
    told = capsys.readouterr().out
    assert told.startswith("298 rows in 2 runs (2 stretches without a break), 0.02 s apart: 6.0 s\n")
    for words in ("shoulder_speed", "rad/s", "'nothing changes'", "body_mass.upper", "× noise", "nothing to warn of"):
        assert words in told


@pytest.mark.slow
def test_json_and_a_forecast(arm, capsys):
    files = [str(arm / "logs" / f"{seed}.csv") for seed in (0, 1)]
    assert main(["check", str(arm / "arm.yaml"), "--json", "--data", *files]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["rows"], told["runs"], told["fatal"]) == (298, 2, False)
    assert [finding["level"] for finding in told["findings"]] == ["note"]
    assert set(told["parameters"]) == {"body_mass.upper", "body_mass.fore", "dof_damping.shoulder", "dof_damping.elbow"}
    assert told["explanation"]["horizons"] == [1, 5, 20]
    quick, npe = told["forecast"]
    assert quick["method"] == "least-squares"
    assert 0.0 < quick["seconds"] < npe["seconds"]
    assert npe["control_steps"] == 300_000


def test_what_is_fatal_is_told_and_ends_with_code_2(arm, tmp_path, capsys):
    columns = columns_of(arm_of(tmp_path), 20)
    file = write_csv(tmp_path / "log.csv", {name: values for name, values in columns.items() if name != "elbow"})
    assert main(["check", str(arm / "arm.yaml"), "--json", "--data", str(file)]) == 2
    (finding,) = json.loads(capsys.readouterr().out)["findings"]
    assert finding["level"] == "fatal"
    assert finding["what"].startswith("no column 'elbow' in log.csv; nearest: elbow_speed")
    assert main(["check", str(arm / "arm.yaml"), "--data", str(file)]) == 2
    assert capsys.readouterr().out.startswith("fatal: no column 'elbow'")


def test_a_calibration_of_a_log_goes_with_its_warnings_and_stops_at_what_is_fatal(arm, tmp_path, capsys):
    columns = columns_of(arm_of(tmp_path), 150)
    late = write_csv(tmp_path / "late.csv", columns | {"time": columns["time"] + (columns["time"] > 1.0)})
    words = ["calibrate", str(arm / "arm.yaml"), "--method", "least-squares", "--quiet", "--json"]
    assert main([*words, "--data", str(late), "--out", str(tmp_path / "run"), "--budget", "100000"]) == 0
    warnings = json.loads(capsys.readouterr().out)["warnings"]
    assert any("late.csv: 1 of 149 time steps are more than 10 % off" in warning for warning in warnings)
    dead = {name: values if name == "time" or "torque" in name else 0 * values for name, values in columns.items()}
    file = write_csv(tmp_path / "dead.csv", dead)
    assert main([*words, "--data", str(file), "--out", str(tmp_path / "other")]) == 2
    assert "the data is refused: shoulder: it never moves: 0 in all 149 rows" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()
