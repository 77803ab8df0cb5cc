"""From a model to a calibrated robot of one's own, as a new user would."""

import json
import shutil
from collections import Counter

import jax
import mujoco
import pytest
from command_line import asked_for_json, without_seconds

from madoc import data, robots
from madoc.commands.main import main
from madoc.robots import spec
from own_robots import ARM_SPEC, PENDULUM_SPEC, SPRING_SPEC, write_robot
from robots import ARM, ARM_TRUTH, recorded

FIT = ["--method", "least-squares", "--budget", "100000", "--quiet", "--set", "windows=100"]

KEY = jax.random.key(1)


@pytest.fixture
def arm(tmp_path):
    """A spec, and 600 rows of its robot at known parameters."""
    path = write_robot(tmp_path, ARM_SPEC + "max_episode_steps: 100\nreward: -abs(shoulder_angle)\n", "arm.yaml")
    log = tmp_path / "log.npz"
    data.save(recorded(robots.load(path).task, ARM_TRUTH, 600, jax.random.key(1)), log)
    return path, log


def test_a_calibration_reads_the_robot_once_and_compiles_its_model_once(arm, tmp_path, monkeypatch):
    """`robots.load` parses the spec; all simulators, checks and the export of evidence share the compiled model."""
    counts = Counter()

    def counted(name, function):
        def count(*arguments, **options):
            counts[name] += 1
            return function(*arguments, **options)

        return count

    monkeypatch.setattr(spec, "read_document", counted("parsed", spec.read_document))
    monkeypatch.setattr(mujoco.MjSpec, "compile", counted("compiled", mujoco.MjSpec.compile))
    path, log = arm
    path.write_text(path.read_text() + "# unlike every robot that this process has read\n")
    words = ["calibrate", str(path), "--data", str(log), "--out", str(tmp_path / "run"), "--holdout", "0.2", *FIT]
    assert main(words) in (0, 10, 11, 12)
    assert counts == {"parsed": 1, "compiled": 1}


def test_init_then_spec(tmp_path, capsys):
    model = tmp_path / "arm.xml"
    model.write_text(ARM)
    answer, code = asked_for_json(capsys, ["init", model])
    assert code == 0
    assert answer == {
        **{"spec": str(tmp_path / "arm.yaml"), "name": "arm", "signals": 4, "actions": 2, "parameters": 4}
    }
    described, code = asked_for_json(capsys, ["spec", answer["spec"]])
    assert code == 0
    assert described["physics_steps"] == 2
    assert described["state_can_be_rebuilt"] is True
    assert described["parameters"][0] == {
        **{"name": "body_mass.upper", "field": "body_mass", "elements": ["upper"], "unit": "kg"},
        **{"low": 0.5, "high": 2.0, "model": [1.0]},
    }
    assert described["actions"][1]["control"] == [-1.0, 1.0]
    assert main(["init", str(model)]) == 2
    assert "arm.yaml exists already" in capsys.readouterr().err


def test_spec_as_tables(tmp_path, capsys):
    hidden = ARM_SPEC.replace("  - {name: elbow_speed, reads: velocity(elbow)}\n", "")
    shared = "  - {field: dof_frictionloss, elements: [shoulder, elbow], name: friction, low: 0, high: 1}\n"
    spec = hidden.replace("groups: 2", shared + "  - {field: action_delay, low: 0, high: 0.03}")
    assert main(["spec", str(write_robot(tmp_path, spec))]) == 0
    told = capsys.readouterr().out
    for words in (
        *("two_link_arm: signals", "shoulder_motor", "dof_damping.elbow", "N·m·s/rad", "shoulder, elbow"),
        "one action every 0.02 s, 2 physics steps each; 7 parameters",
        "states cannot be rebuilt from the log, as no signal is the velocity of elbow: least-squares estimates them",
        "a state carries the last 2 actions",
        "no reward: madoc learn refuses this robot until the spec has one",
    ):
        assert words in told


def test_velocities_from_positions_are_asked_for(tmp_path, capsys):
    path = write_robot(tmp_path, PENDULUM_SPEC, "pendulum.yaml")
    task, log = robots.load(path).task, tmp_path / "log.npz"
    data.save(recorded(task, dict(zip(task.parameters.names, (1.2, 0.15, 1.6), strict=True)), 300, KEY), log)
    command = ["calibrate", path, "--data", log, "--method", "droid", "--budget", "2000", "--quiet"]
    assert main([str(word) for word in command]) == 2
    assert "does not determine its state" in capsys.readouterr().err
    answer, code = asked_for_json(capsys, [*command, "--out", tmp_path / "run", "--velocities", "differences"])
    assert code == 0
    assert any("velocities are differences of positions" in warning for warning in answer["warnings"])
    arm_path = write_robot(tmp_path, ARM_SPEC, "arm.yaml")
    data.save(recorded(robots.load(arm_path).task, ARM_TRUTH, 300, KEY), log)
    assert main(["calibrate", str(arm_path), "--data", str(log), "--velocities", "differences"]) == 2
    assert "has velocities; velocities=differences is for data without" in capsys.readouterr().err


def test_the_schema(capsys, tmp_path):
    schema, code = asked_for_json(capsys, ["spec", "--schema"])
    assert code == 0
    assert schema["additionalProperties"] is False
    assert "signals" in schema["required"]
    assert main(["spec", "--schema"]) == 0
    assert json.loads(capsys.readouterr().out) == schema


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["spec"], "expected the spec file of a robot, as madoc spec robot.yaml"),
        (["spec", "nothing.yaml"], "nothing.yaml, which does not exist"),
        (["init", "nothing.xml"], "there is no model file nothing.xml: it is missing"),
        (["init", "."], "there is no model file .: it is a directory"),
        (["init", ""], "there is no model file .: it is a directory"),
        (["calibrate", "hopper", "--data", ""], "expected the log after --data, got nothing"),
        (["calibrate", "nothing.yaml", "--data", "x.npz"], "nothing.yaml, which does not exist"),
        (["calibrate", "nothing", "--data", "x.npz"], "unknown task 'nothing'"),
    ],
)
def test_refusals(words, sentence, capsys):
    assert main(words) == 2
    told = capsys.readouterr().err
    assert sentence in told
    assert told.count("\n") == 1


def test_calibrate_learn_and_evaluate_without_the_users_files(arm, tmp_path, capsys):
    spec, log = arm
    out = tmp_path / "run"
    command = ["calibrate", spec, "--data", log, "--out", out, *FIT]
    answer, code = asked_for_json(capsys, command)
    assert code == 0
    assert answer["task"] == "two_link_arm"
    assert answer["error"]["mean_percent_of_range"] < 1e-4
    kept = json.loads((out / "spec.json").read_text())["robot"]
    assert kept["spec"] == spec.read_text()
    assert kept["model"]["contents"]["arm.xml"] == ARM
    again, code = asked_for_json(capsys, [*command, "--resume"])
    assert (without_seconds(again), code) == (without_seconds(answer), 0)
    # The spec has changed: this is another robot.
    text = spec.read_text()
    spec.write_text(text.replace("high: 0.5", "high: 0.6"))
    assert main([str(word) for word in [*command, "--resume"]]) == 2
    told = capsys.readouterr().err
    assert "cannot resume" in told
    assert len(told) < 500
    # What follows needs the run folder alone.
    for file in (spec, tmp_path / "arm.xml"):
        file.unlink()
    moved = tmp_path / "moved"
    shutil.copytree(out, moved)
    learning = ["--method", "bc", "--budget", "100", "--quiet", "--set", "hidden=[8]", "batch=32"]
    _, code = asked_for_json(capsys, ["learn", moved, *learning])
    assert code == 0
    evaluation, code = asked_for_json(capsys, ["evaluate", moved, "--episodes", "2", "--quiet"])
    assert code == 0
    assert evaluation["task"] == "two_link_arm"


def test_learn_needs_a_reward(arm, tmp_path, capsys):
    spec, log = arm
    spec.write_text(spec.read_text().replace("reward: -abs(shoulder_angle)\n", ""))
    out = tmp_path / "run"
    assert main([str(word) for word in ["calibrate", spec, "--data", log, "--out", out, *FIT]]) == 0
    capsys.readouterr()
    assert main(["learn", str(out)]) == 2
    assert "two_link_arm has no reward, so no policy can be learnt for it" in capsys.readouterr().err
    assert main(["run", str(spec), "--data", str(log), "--out", str(tmp_path / "all")]) == 2
    assert "has no reward" in capsys.readouterr().err
    assert not (tmp_path / "all").exists()


def test_a_run_folder_that_holds_the_logs_is_refused(tmp_path, capsys):
    spec = write_robot(tmp_path, SPRING_SPEC)
    logs = tmp_path / "logs"
    logs.mkdir()
    (logs / "0.csv").write_text("time,place,speed,push\n0,0,0,0\n0.02,0,0,0\n")
    assert main(["calibrate", str(spec), "--data", str(logs), "--out", str(logs), "--quiet"]) == 2
    assert "holds the log" in capsys.readouterr().err
    assert [file.name for file in logs.iterdir()] == ["0.csv"]
