import pytest
from command_line import asked_for_json

from madoc import data, tasks
from madoc.commands.main import main
from madoc.data.targets import paper_truth


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
