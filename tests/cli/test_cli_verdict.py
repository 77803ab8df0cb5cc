"""Hold-outs, verdicts, `auto` and the selftest from the command line."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from command_line import asked_for_json

from madoc import data
from madoc.calibration import CalibrationResult, LeastSquares, Npe
from madoc.commands.answer import EXIT_CODES
from madoc.commands.main import main
from madoc.data import Disturbance, disturb
from madoc.errors import MadocError
from madoc.pipeline import read_calibration
from madoc.tasks import TASKS, make
from robots import SPRING_TRUTH, recorded, spring

TINY = [
    *("npe.draws=8", "npe.horizon=5", "npe.epochs=1", "npe.hidden=[8]", "npe.fitting_epochs=2", "npe.updates=5"),
    *("npe.batch=16", "npe.replay_capacity=300", "npe.flow_layers=1", "npe.flow_width=4", "npe.flow_updates=8"),
    *("npe.samples=50", "npe.cloning_epochs=2", "npe.cloning_updates=3", "npe.cloning_batch=16"),
]
"""Every stage of npe in epochs of milliseconds."""


def listed(physics):
    """The spring as `madoc.tasks` would list it."""
    return replace(spring(max_episode_steps=100), physics=physics, velocities=1)


@pytest.fixture(scope="module", autouse=True)
def _spring_is_listed():
    """The spring is a robot of the command line, while these tests run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(TASKS, "spring", listed)
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


def test_auto_takes_least_squares_where_states_can_be_had(log, tmp_path, capsys):
    out = tmp_path / "run"
    ask = words("calibrate", log, "--budget", 30_000, "--out", out)
    answer, code = asked_for_json(capsys, ask)
    assert (answer["verdict"]["word"], code) == ("CALIBRATED", 0)
    assert answer["method"] == "least-squares"
    assert answer["chosen"].startswith("auto took least-squares: ")
    assert answer == read(out / "result.json")
    assert CalibrationResult.from_json(answer).to_json() == answer
    spec = read(out / "spec.json")
    assert (spec["holdout"], spec["method"], spec["budget"]) == (0.2, "least-squares", 30_000)
    with np.load(out / "evidence.npz", allow_pickle=False) as evidence:
        assert evidence["after"] == pytest.approx(evidence["measured"], abs=1e-9)
    assert list(out.rglob("result.json")) == [out / "result.json"]
    assert read_calibration(out).result.method == "least-squares"
    again, code = asked_for_json(capsys, [*ask, "--resume"])
    assert (again | {"judging_seconds": answer["judging_seconds"]}, code) == (answer, 0)


def test_the_verdict_is_read_before_the_table(log, tmp_path, capsys):
    ask = words("calibrate", log, "--method", "auto", "--budget", 30_000, "--out", tmp_path / "run")
    assert main([str(word) for word in ask]) == 0
    told = capsys.readouterr().out
    assert told.startswith("CALIBRATED: over ")
    assert told.index("CALIBRATED") < told.index("jnt_stiffness.slide") < told.index("auto took least-squares")
    assert "what to do: use the model, within the intervals of its values" in told


def test_a_bare_method_holds_out_where_asked_and_leaves_with_its_verdict(log, tmp_path, capsys):
    ask = words("calibrate", log, "--method", "nominal", "--holdout", "0.3", "--out", tmp_path / "run")
    answer, code = asked_for_json(capsys, ask)
    assert (answer["verdict"]["word"], code) == ("NO_IMPROVEMENT", 10)
    assert answer["holdout"]["rows"] == 300
    plain, code = asked_for_json(capsys, words("calibrate", log, "--method", "nominal", "--out", tmp_path / "plain"))
    assert code == 0
    assert not {"verdict", "holdout", "chosen"} & plain.keys()
    assert "holdout" not in read(tmp_path / "plain" / "spec.json")


def test_auto_leaves_nothing_where_every_method_refuses(log, tmp_path, capsys, monkeypatch):
    def refuse(method, problem, key):
        raise MadocError("it cannot")

    for method in (LeastSquares, Npe):
        monkeypatch.setattr(method, "init", refuse)
    ask = words("calibrate", log, "--method", "auto", "--out", tmp_path / "run")
    assert main([str(word) for word in ask]) == 2
    assert "least-squares refuses: it cannot; npe refuses: it cannot" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_rejected_data_ends_auto_with_a_code_of_its_own(log, tmp_path, capsys):
    whole = data.load(str(log), make("spring"), format=None, max_transitions=None, key=jax.random.key(0))
    order = np.random.default_rng(0).permutation(len(whole))
    following = np.asarray(whole.transitions.next_observation)[order]
    data.save(replace(whole, transitions=replace(whole.transitions, next_observation=following)), tmp_path / "bad.npz")
    ask = words("calibrate", tmp_path / "bad.npz", "--method", "auto", "--budget", 10_000, "--out", tmp_path / "run")
    answer, code = asked_for_json(capsys, ask)
    assert (answer["verdict"]["word"], code) == ("DATA_REJECTED", 13)


@pytest.mark.slow
def test_where_least_squares_refuses_auto_runs_npe_and_says_why(log, tmp_path, capsys):
    whole = data.load(str(log), make("spring"), format=None, max_transitions=None, key=jax.random.key(0))
    lost = disturb(whole, Disturbance(hidden_velocities=True, shuffled="rows"), make("spring"), jax.random.key(0))
    data.save(lost, tmp_path / "lost.npz")
    ask = words("calibrate", tmp_path / "lost.npz", "--method", "auto", "--budget", 2000, "--out", tmp_path / "run")
    answer, code = asked_for_json(capsys, [*ask, "--set", *TINY])
    # So few epochs calibrate nothing, and the verdict does not say that they do.
    assert (answer["method"], code) == ("npe", EXIT_CODES[answer["verdict"]["word"]])
    assert answer["verdict"]["word"] != "CALIBRATED"
    assert answer["chosen"].startswith("auto took npe: least-squares refuses: expected at least as many readings")
    spec = read(tmp_path / "run" / "spec.json")
    assert (spec["method"], spec["hyperparameters"]["updates"]) == ("npe", 5)


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--holdout", "1.5"], "expected a share of the rows to hold out between 0 and 1, got 1.5"),
        (["--budget", "0"], "a budget of at least 1"),
        (["--set", "updates=2"], "there are: least-squares.NAME, npe.NAME"),
        (["--set", "npe.update=2"], "did you mean updates"),
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
