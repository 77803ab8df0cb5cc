"""What an export of a robot with drives leaves, from a result that no calibration had to find."""

import json

from madoc import robots
from madoc.calibration import CalibrationResult, ParameterEstimate
from madoc.commands.main import main
from madoc.pipeline import export_run
from own_robots import SERVO, SERVO_SPEC, write_robot


def test_a_drive_goes_to_bam_and_no_file_for_trainers_leaves_it_out(tmp_path, capsys):
    spec = SERVO_SPEC.replace(
        "parameters:", "friction:\n  - {joint: shaft, model: M1, coulomb: 0.1, viscous: 0.2}\nparameters:"
    )
    spec = spec.replace("parameters:\n", "parameters:\n  - {field: action_delay, low: 0, high: 0.02}\n")
    rows = {
        "action_delay": ParameterEstimate(0.004, 0.001, 0.0, 0.02, "s"),
        "drive_strength.goal": ParameterEstimate(0.8, 0.01, 0.5, 1.5, "1"),
    }
    task = robots.load(write_robot(tmp_path, spec, servo=SERVO)).task
    result = CalibrationResult("m", task.name, "finished", "", 0, 0.0, 0, [], rows)
    (tmp_path / "result.json").write_text(json.dumps(result.to_json()))
    (tmp_path / "spec.json").write_text(json.dumps({"task": task.name, "robot": dict(task.source)}))
    files = export_run(tmp_path / "result.json", tmp_path / "out")
    drive = json.loads(files["drive goal for BAM"].read_text())
    assert (drive["R"], drive["command_delay"], drive["kp"]) == (2.5, 0.004, 2.0)
    assert (drive["friction_base"], drive["friction_viscous"]) == (0.1, 0.2)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "bam-goal.json",
        "draws.npz",
        "draws.py",
        "drives.py",
        "model.xml",
        "patch.yaml",
        "randomization.yaml",
        "sysid_parameters.yaml",
    ]
    assert main(["export", str(tmp_path / "result.json"), "--out", str(tmp_path / "out")]) == 0
    assert "no robot for mjlab and Isaac Lab" in capsys.readouterr().out
