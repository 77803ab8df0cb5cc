"""Hold-outs, verdicts, `auto` and the selftest from the command line."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from command_line import asked_for_json, without_seconds

import comparing
from madoc import data
from madoc.calibration import CalibrationResult, LeastSquares
from madoc.commands.main import main
from madoc.data import Disturbance, disturb
from madoc.pipeline import calibration_stage, read_calibration
from madoc.tasks import TASKS, make
from robots import SPRING_TRUTH, recorded


@pytest.fixture(scope="module", autouse=True)
def _spring_is_listed():
    """The spring is a robot of the command line, while these tests run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(TASKS, "spring", comparing.listed)
        yield


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A thousand rows of the spring."""
    path = tmp_path_factory.mktemp("data") / "spring.npz"
    data.save(recorded(make("spring"), SPRING_TRUTH, 1000, jax.random.key(1)), path)
    return path


def words(command, log, *more):
    return [command, "spring", "--data", log, "--quiet", *more]


def read(path):
    return json.loads(path.read_text())


def test_auto_keeps_least_squares_where_that_explains_all(log, tmp_path, capsys):
    out = tmp_path / "run"
    ask = words("calibrate", log, "--method", "auto", "--budget", 30_000, "--out", out)
    answer, code = asked_for_json(capsys, ask)
    assert (answer["verdict"]["word"], code) == ("CALIBRATED", 0)
    assert answer["holdout"]["chosen"] == answer["method"] == "least-squares"
    ran, skipped = answer["holdout"]["candidates"]
    assert ran["verdict"] == "CALIBRATED"
    assert skipped == {"method": "madoc-local", "not_run": "least-squares explains the hold-out down to its noise"}
    assert answer == read(out / "result.json")
    assert read(out / "comparison.json")["candidates"] == [ran, skipped]
    assert CalibrationResult.from_json(answer).to_json() == answer
    assert read(out / "spec.json")["holdout"] == 0.2
    with np.load(out / "evidence.npz", allow_pickle=False) as evidence:
        assert evidence["after"] == pytest.approx(evidence["measured"], abs=1e-9)
    part = read(out / "least-squares" / "result.json")
    assert without_seconds(part["parameters"]) == without_seconds(answer["parameters"])
    assert read_calibration(out).result.method == "least-squares"
    again, code = asked_for_json(capsys, [*ask, "--resume"])
    assert (again, code) == (answer, 0)


def test_auto_goes_on_to_the_next_method_when_the_first_diverges(log, tmp_path, capsys, monkeypatch):
    step, by, taken = LeastSquares.step, calibration_stage._calibrate_by, []

    def failing(method, problem, state):
        """The third step leaves a curvature that is not finite."""
        following, epoch = step(method, problem, state)
        taken.append(epoch)
        if len(taken) == 3:
            broken = replace(following.known, bread=np.full_like(following.known.bread, np.nan))
            following = replace(following, known=broken)
        return following, epoch

    monkeypatch.setattr(LeastSquares, "step", failing)
    monkeypatch.setattr(calibration_stage, "_calibrate_by", lambda _, *where, **how: by(LeastSquares(), *where, **how))
    ask = words("calibrate", log, "--method", "auto", "--budget", 60_000, "--out", tmp_path / "run")
    answer, _ = asked_for_json(capsys, ask)
    diverged, kept = answer["holdout"]["candidates"]
    assert (diverged["method"], kept["method"], answer["holdout"]["chosen"]) == (
        "least-squares",
        "madoc-local",
        "madoc-local",
    )
    assert diverged["not_run"].startswith("it diverged: stopped at")
    parts = [read(tmp_path / "run" / name / "result.json") for name in ("least-squares", "madoc-local")]
    assert parts[0]["status"] == "diverged"
    assert answer["control_steps"] == sum(part["control_steps"] for part in parts)


@pytest.mark.slow
def test_auto_lets_madoc_begin_at_least_squares_estimate(log, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(calibration_stage, "_reason_to_stop", lambda tried: "")
    out = tmp_path / "run"
    ask = words("calibrate", log, "--method", "auto", "--budget", 30_000, "--set", *comparing.TINY, "--out", out)
    asked_for_json(capsys, ask)
    first, second = (read(out / name / "result.json") for name in ("least-squares", "madoc-local"))
    assert second["began"] == "Madoc began at the estimate of least squares"
    assert "began" not in first
    estimates = [row["estimate"] for row in first["parameters"].values()]
    prior = read(out / "madoc-local" / "spec.json")["prior"]
    assert (prior["mean"], prior["origin"]) == (estimates, "the estimate of least squares")
    assert not {"prior"} & (read(out / "spec.json").keys() | read(out / "least-squares" / "spec.json").keys())
    (out / "result.json").unlink()
    (out / "comparison.json").unlink()
    asked_for_json(capsys, [*ask, "--resume"])
    again = read(out / "madoc-local" / "result.json")
    assert without_seconds(again) == without_seconds(second)


def test_the_verdict_is_read_before_the_table(log, tmp_path, capsys):
    ask = words("calibrate", log, "--method", "auto", "--budget", 30_000, "--out", tmp_path / "run")
    assert main([str(word) for word in ask]) == 0
    told = capsys.readouterr().out
    assert told.startswith("CALIBRATED: the prediction error on the hold-out is")
    assert "methods compared on the hold-out" in told
    assert told.index("CALIBRATED") < told.index("jnt_stiffness.slide") < told.index("methods compared")


def test_a_bare_method_holds_out_where_asked_and_leaves_with_its_verdict(log, tmp_path, capsys):
    ask = words("calibrate", log, "--method", "nominal", "--holdout", "0.3", "--out", tmp_path / "run")
    answer, code = asked_for_json(capsys, ask)
    assert (answer["verdict"]["word"], code) == ("NO_IMPROVEMENT", 10)
    assert answer["holdout"]["rows"] == 300
    plain, code = asked_for_json(capsys, words("calibrate", log, "--method", "nominal", "--out", tmp_path / "plain"))
    assert code == 0
    assert not {"verdict", "holdout"} & plain.keys()
    assert "holdout" not in read(tmp_path / "plain" / "spec.json")


def test_auto_leaves_nothing_where_every_candidate_refuses(log, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(calibration_stage, "_refusal", lambda method, prepared: "refused: it cannot")
    ask = words("calibrate", log, "--method", "auto", "--out", tmp_path / "run")
    assert main([str(word) for word in ask]) == 2
    assert "least-squares: refused: it cannot; madoc-local: refused: it cannot" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_rejected_data_ends_auto_with_a_code_of_its_own(log, tmp_path, capsys):
    whole = data.load(str(log), make("spring"), format=None, max_transitions=None, key=jax.random.key(0))
    order = np.random.default_rng(0).permutation(len(whole))
    following = np.asarray(whole.transitions.next_observation)[order]
    data.save(replace(whole, transitions=replace(whole.transitions, next_observation=following)), tmp_path / "bad.npz")
    ask = words("calibrate", tmp_path / "bad.npz", "--method", "auto", "--budget", 10_000, "--out", tmp_path / "run")
    answer, code = asked_for_json(capsys, ask)
    assert (answer["verdict"]["word"], code) == ("DATA_REJECTED", 13)
    assert answer["holdout"]["candidates"][1]["not_run"] == "the data was rejected, and no method changes that"


def test_a_refusal_is_a_row_and_the_next_method_runs(log, tmp_path, capsys):
    whole = data.load(str(log), make("spring"), format=None, max_transitions=None, key=jax.random.key(0))
    task = make("spring")
    lost = disturb(whole, Disturbance(shuffled="next_observations"), task, jax.random.key(0))
    data.save(lost, tmp_path / "lost.npz")
    ask = words("calibrate", tmp_path / "lost.npz", "--method", "auto", "--budget", 2000, "--out", tmp_path / "run")
    answer, code = asked_for_json(capsys, [*ask, "--set", *comparing.TINY])
    refused, ran = answer["holdout"]["candidates"]
    assert refused["method"] == "least-squares"
    assert refused["not_run"].startswith("refused: this method compares each row's next")
    assert (ran["method"], ran["verdict"], code) == ("madoc-local", "DATA_REJECTED", 13)
    assert not (tmp_path / "run" / "least-squares").exists()


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--holdout", "1.5"], "expected a share of the rows to hold out between 0 and 1, got 1.5"),
        (["--budget", "0"], "a budget of at least 1"),
        (["--set", "updates=2"], "there are: least-squares.NAME, madoc-local.NAME"),
        (["--set", "madoc-local.update=2"], "did you mean updates"),
    ],
)
def test_what_auto_cannot_do_is_refused_and_leaves_nothing(log, tmp_path, capsys, more, told):
    ask = words("calibrate", log, "--method", "auto", "--out", tmp_path / "run", *more)
    assert main([str(word) for word in ask]) == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_the_selftest_passes_where_the_data_can(log, capsys):
    answer, code = asked_for_json(capsys, words("selftest", log, "--truths", 1, "--budget", 20_000))
    assert (answer["passed"], code) == (True, 0)
    assert answer["method"] == "least-squares"
    assert main([str(word) for word in words("selftest", log, "--truths", 1, "--budget", 20_000)]) == 0
    told = capsys.readouterr().out
    assert told.startswith("this data could find every parameter")
    assert "planted" in told


def test_the_selftest_fails_with_a_code_of_its_own(log, capsys):
    ask = words("selftest", log, "--truths", 1, "--method", "nominal")
    answer, code = asked_for_json(capsys, ask)
    assert (answer["passed"], code) == (False, 14)
    assert "could not find" in answer["sentence"]
