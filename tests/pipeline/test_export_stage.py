"""What an export of a robot with drives leaves, from a result that no calibration had to find, and what it loses.

Clauses with the size of what is lost are told from errors given by hand.
"""

import json

import numpy as np
import pytest

from madoc import robots, simulation
from madoc.calibration import CalibrationResult, ParameterEstimate
from madoc.commands.main import main
from madoc.pipeline import export_run, export_stage
from madoc.pipeline.export_stage import Losses, losses
from own_robots import SERVO, SERVO_SPEC, SPRING_SPEC, write_robot

STARTS = {"start": np.zeros((1, 1))}


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


@pytest.fixture
def simulator(tmp_path):
    """A spring with steps of 20 ms, of which ten are the physics'; its stiffness, damping and mass, and a delay."""
    spec = SPRING_SPEC + "  - {field: action_delay, low: 0, high: 0.1}\n"
    return simulation.make(robots.load(write_robot(tmp_path, spec)).task, threads=1)


def test_each_loss_is_the_error_beside_that_of_the_estimate(simulator, monkeypatch):
    step = simulator.control_step / simulator.task.frame_skip
    mean = np.full(len(simulator.parameters), 5.3 * step)
    asked = []

    def errors(evidence, simulator, values):
        asked.append(values)
        return np.array([2.0, 3.0, 4.0, np.inf, 5.0, 2.2, 3.0, 3.0, 6.0, 6.0])[: len(values)]

    monkeypatch.setattr(export_stage, "replay_errors", errors)
    own = [(0.0,), (1.0, 1.0), (2.0,), (0.0,)]
    own[1] = (1.0, 3.0)  # two elements that differ: there is no one value to leave
    draws = np.array([[1.0, 1.0, 1.0, 1.0], [2.0, 2.0, 2.0, 2.0]])
    found = losses(STARTS, simulator, mean, own, draws)
    assert found == Losses(
        [
            "; left out, the error over held-out runs is 1.5 times as large",
            "",
            "; left out, the error over held-out runs has no bound, as simulations fail",
            "; left out, the error over held-out runs is 2.5 times as large",
        ],
        rounded="; so, the error over held-out runs is 1.1 times as large",
        independent="2 times the error of whole rows over held-out runs",
    )
    (values,) = asked
    assert values[1].tolist() == [0.0, *mean[1:]] and values[4].tolist() == [*mean[:3], 0.0]
    assert values[5] == pytest.approx([*mean[:3], 5.0 * step])
    assert sorted(values[8:, 0].tolist()) == [1.0, 2.0]


def test_nothing_is_said_where_the_run_folder_does_not_tell(simulator):
    mean = simulator.parameters.middle
    assert losses({}, simulator, mean, [(0.0,)] * len(mean), mean[None]) == Losses([""] * len(mean))
