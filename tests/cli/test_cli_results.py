import json

import mujoco
import numpy as np
import pytest
from command_line import asked_for_json
from ruamel.yaml import YAML

from madoc.commands.main import main
from madoc.pipeline import read_calibration
from madoc.simulation import make

read_yaml = YAML(typ="safe").load


def test_a_run_is_exported_beside_itself(whole, tmp_path, capsys):
    told, code = asked_for_json(capsys, ["export", whole, "--out", tmp_path / "out"])
    assert code == 0
    names = ["draws.npz", "draws.py", "isaac_lab_robot.py", "mjlab_robot.py", "model.xml", "patch.yaml"]
    names += ["randomization.yaml", "sysid_parameters.yaml"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names
    assert told["files"]["model"] == str(tmp_path / "out" / "model.xml")
    calibrated = read_calibration(whole)
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "model.xml"))
    np.testing.assert_array_equal(written.body_mass, make(calibrated.task).model(calibrated.result.mean).body_mass)
    patch = read_yaml((tmp_path / "out" / "patch.yaml").read_text())
    spec = json.loads((whole / "calibration" / "spec.json").read_text())
    assert patch["provenance"]["data"]["fingerprint"] == spec["data"]["fingerprint"]
    assert patch["stepping"]["physics_steps_per_control_step"] == 4
    assert [row["new"] for row in patch["parameters"]] == calibrated.result.mean.tolist()
    ranges = read_yaml((tmp_path / "out" / "randomization.yaml").read_text())
    spread = np.array([row["std"] for row in ranges["parameters"].values()])
    np.testing.assert_allclose(1.96 * spread, calibrated.half_widths, rtol=1e-3)
    assert main(["export", str(whole), "--out", str(tmp_path / "out"), "--quiet"]) == 0  # over an export of its own
    (tmp_path / "out" / "patch.yaml").write_text("mine")
    assert main(["export", str(whole), "--out", str(tmp_path / "out")]) == 2
    assert "holds model.xml, patch.yaml, randomization.yaml" in capsys.readouterr().err
    assert (tmp_path / "out" / "patch.yaml").read_text() == "mine"


def test_policies_go_along_as_onnx_when_asked(whole, tmp_path):
    pytest.importorskip("onnx", reason="onnx is not installed")
    assert main(["export", str(whole), "--out", str(tmp_path), "--onnx"]) == 0
    assert sorted(path.name for path in tmp_path.glob("*.onnx")) == [
        "policy-calibrated.onnx",
        "policy-midrange.onnx",
        "policy-truth.onnx",
    ]


@pytest.mark.parametrize("words", [["nowhere"], ["{whole}/policy-calibrated"]])
def test_what_is_no_calibration_is_refused_and_nothing_written(whole, tmp_path, capsys, words):
    asked = [word.format(whole=whole) for word in words]
    assert main(["export", *asked, "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_run_leaves_its_page(whole):
    text = (whole / "report.html").read_text()
    assert [
        id for id in ("estimates", "curves", "policies", "cost", "asked") if f'<section id="{id}">' not in text
    ] == []


def test_one_run_is_shown_and_two_are_compared(whole, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told, code = asked_for_json(capsys, ["report", whole, "--out", "one.html"])
    assert (code, told["page"]) == (0, "one.html")
    told, code = asked_for_json(capsys, ["report", whole, whole / "calibration"])
    assert (code, told["page"]) == (0, "comparison.html")
    assert "2 runs" in (tmp_path / "comparison.html").read_text()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["nowhere"], "there is no run folder nowhere"),
        (["{whole}/policy-calibrated"], "holds a policy, not a calibration"),
        (["{whole}", "--out", "{whole}/data.npz"], "is no page of madoc report"),
        ([], "expected a run folder"),
    ],
)
def test_mistakes_are_answered_with_a_sentence(whole, capsys, words, sentence):
    assert main(["report", *(word.format(whole=whole) for word in words)]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and sentence in told
