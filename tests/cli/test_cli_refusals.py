import json

import numpy as np
import pytest
from command_line import arguments

from madoc.commands.main import main

CALIBRATE = "calibrate hopper --data {data} --out {out} "
MADOC = CALIBRATE + "--method madoc "


@pytest.fixture
def places(recorded, whole, tmp_path):
    """Files to be refused, by name."""
    corrupt, narrow = tmp_path / "corrupt.npz", tmp_path / "narrow.npz"
    corrupt.write_bytes(recorded.read_bytes()[:5000])
    with np.load(recorded) as arrays:
        columns = dict(arrays)
    for name in ("observation", "next_observation"):
        columns[name] = columns[name][:, :10]
    np.savez(narrow, **columns)
    truths = {
        "words": "not JSON",
        "list": "[1, 2]",
        "text": '{"gravity": "down"}',
        "nan": '{"gravity": NaN}',
        "strange": '{"gravty": -9.81}',
        "part": '{"gravity": -9.81}',
    }
    for name, text in truths.items():
        (tmp_path / f"{name}.json").write_text(text)
    names = {name: tmp_path / f"{name}.json" for name in truths}
    out = tmp_path / "out"
    return names | {"data": recorded, "corrupt": corrupt, "narrow": narrow, "used": whole, "out": out}


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("", "Expected one of"),
        ("calibrat hopper", "Unrecognized options: calibrat"),
        (CALIBRATE + "--budgt 3", "--budget"),
        (CALIBRATE + "--budget many", "expected a budget such as 300000, 300s"),
        ("calibrate hopper", "madoc calibrate: --data must be given"),
        (CALIBRATE + "--seed x", "--seed: expected a whole number, got 'x'"),
        (CALIBRATE + "--holdout x", "--holdout: expected a number, got 'x'"),
        (f"calibrate hopper --data {'x' * 300}.npz --out {{out}}", "File name too long; check the path"),
        ("record hoper-medium --out {out}", "did you mean hopper?"),
        ("record hopper-medum --out {out}", "did you mean medium?"),
        ("record hopper --out {out}", "expected TASK-QUALITY"),
        ("record hopper-medium --out {out} --transitions 0", "at least 1 transition"),
        ("record hopper-medium --out {out} --seed -1", "seed"),
        ("record hopper-medium --out {out}/log.npz", "no folder"),
        ("record hopper-medium --out {out} --noise -1", "noise as a share of a step's change"),
        ("record hopper-medium --out {out} --friction 0", "friction as a positive multiple"),
        (CALIBRATE + "--method dropo --hide-velocities", "does not determine its state"),
        (CALIBRATE + "--hide-velocities --velocities differences", "does not show the position of rootx"),
        (CALIBRATE + "--method least-squares --shuffle next_observations", "are shuffled; take a method"),
        (CALIBRATE + "--method least-squares --shuffle rows --set horizon=2", "data with its rows in order"),
        ("run hoper-medium --out {out}", "did you mean hopper?"),
        ("run hopper --out {out}", "--data FILE"),
        ("run hopper-medium --out {out} --budget -5", "budget"),
        ("run hopper-medium --out {out} --policy-budget 0", "budget of at least 1 control step, got 0"),
        ("run hopper-medium --out {out} --policy-budget soon", "expected a budget such as 300000, 300s"),
        ("run hopper-medium --out {out} --episodes 0", "episode"),
        ("run hopper-medium --out {out} --transitions -1", "transition"),
        ("run hopper-medium --out {out} --method madoc --set colour=1", "unknown hyperparameter of madoc 'colour'"),
        ("run hopper-medium --out {out} --parameters torso", "did you mean body_mass.torso?"),
        ("run hopper-medium --out {out} --level hrad", "no range level 'hrad' for hopper"),
        ("run hopper-medium --out {out} --truth {strange}", "did you mean gravity?"),
        ("run hopper-medium --out {out} --truth {part}", "no value for body_mass.torso"),
        (
            "run hopper-medium --out {out} --learner bc --policy-at distribution",
            "so --policy-at distribution would change nothing",
        ),
        (
            "run hopper-medium --out {out} --learner sac --policy-set randomize=true --policy-at distribution",
            "dr does not learn at given parameters",
        ),
        ("run hopper-medium --out {out} --learner h2o --hide-velocities", "hopper-medium hides velocities"),
        ("run hopper-medium --out {out} --learner sacc", "did you mean sac?"),
        ("run hopper --data {corrupt} --out {out}", "corrupt.npz"),
        ("run hopper-medium --out {used}", "already holds a run"),
        ("run hopper-medium --out {out} --resume", "cannot resume"),
        ("run hopper-medium --out {used} --seed 1 --resume", "cannot resume"),
        ("calibrate hoper --data {data} --out {out}", "did you mean hopper?"),
        ("calibrate hopper --data {out}.npz --out {out}", "no file"),
        ("calibrate hopper --data {corrupt} --out {out}", "corrupt.npz"),
        ("calibrate hopper --data {narrow} --out {out}", "expected 11 values"),
        ("calibrate walker2d --data {data} --out {out}", "hopper"),
        ("learn {used} --method sacc", "unknown method 'sacc'"),
        (CALIBRATE + "--format tape", "unknown format"),
        (CALIBRATE + "--max-transitions 0", "max_transitions"),
        (CALIBRATE + "--level harder", "harder"),
        (CALIBRATE + "--budget -1", "budget"),
        (CALIBRATE + "--seed -1", "seed"),
        (CALIBRATE + "--method madok", "did you mean madoc?"),
        (CALIBRATE + "--parameters torso", "did you mean body_mass.torso?"),
        (CALIBRATE + "--parameters --seed 1", "expected the names of parameters to calibrate, got none"),
        (CALIBRATE + "--parameters gravity gravity", "the parameter gravity is named twice; keep one"),
        (MADOC + "--set updats=2", "did you mean updates?"),
        (MADOC + "--set bound=2", "did you mean agents.bound?"),
        (MADOC + "--set updates=few", "hyperparameter updates of madoc is int, got 'few'"),
        (MADOC + "--set learning_rate=NaN", "learning_rate"),
        (CALIBRATE + "--set updates", "name=value"),
        (CALIBRATE + "--set updates=1 updates=2", "twice"),
        (CALIBRATE + "--starts replay", "--starts"),
        (CALIBRATE + "--resume", "cannot resume"),
        ("calibrate hopper --data {data} --out {used}/calibration", "already holds a run"),
        (CALIBRATE + "--truth {out}.json", "could not read"),
        (CALIBRATE + "--truth {words}", "not valid JSON"),
        (CALIBRATE + "--truth {list}", "list"),
        (CALIBRATE + "--truth {text}", "finite number for gravity"),
        (CALIBRATE + "--truth {nan}", "finite number for gravity"),
        (CALIBRATE + "--truth {strange}", "did you mean gravity?"),
        (CALIBRATE + "--truth {part}", "no value for body_mass.torso"),
        ("learn {out}", "there is no calibration"),
        ("learn {used} --out {out} --method ppo", "unknown method 'ppo'"),
        ("learn {used} --out {out} --budget 0", "budget"),
        ("learn {used}", "already holds a run"),
        ("learn {used} --out {out} --set cloning=[1]", "cloning"),
        ("learn {used} --out {out} --resume", "cannot resume"),
        ("evaluate {out}", "no run folder"),
        ("evaluate {used}/calibration", "no learnt policy"),
        ("evaluate {used} --episodes 0", "episode"),
        ("evaluate {used} --seed -2", "seed"),
        ("evaluate {used} --truth {strange}", "did you mean gravity?"),
    ],
)
def test_a_mistake_is_one_sentence(line, sentence, places, capsys):
    assert main(arguments(line, **places)) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("madoc: ")
    assert told.err.count("\n") == 1
    assert sentence in told.err
    assert not places["out"].exists()


def test_a_refused_calibration_leaves_the_folder_as_it_was(places, capsys):
    out = places["out"]
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    assert main(arguments(CALIBRATE + "--method madoc-s --set group_count=[1]", **places)) == 2
    assert [file.name for file in out.iterdir()] == ["notes.txt"]


def test_an_unfinished_calibration_is_not_learnt_from(places, tmp_path, capsys):
    out = places["out"]
    out.mkdir()
    (out / "spec.json").write_text(json.dumps({"command": "calibrate"}))
    (out / "result.json").write_text(json.dumps({"status": "finished"}))
    assert main(["learn", str(out)]) == 2
    assert "has not ended" in capsys.readouterr().err


def test_a_policy_without_a_known_target_is_not_evaluated(whole, tmp_path, capsys):
    out = tmp_path / "policy"
    out.mkdir()
    (out / "policy.npz").write_bytes((whole / "policy-truth" / "policy.npz").read_bytes())
    spec = json.loads((whole / "policy-truth" / "spec.json").read_text())
    (out / "spec.json").write_text(json.dumps(spec | {"truth": None}))
    assert main(["evaluate", str(out)]) == 2
    assert "pass --truth" in capsys.readouterr().err
