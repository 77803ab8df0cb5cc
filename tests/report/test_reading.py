import numpy as np
import pytest
from run_folders import write_json

from madoc.errors import MadocError
from madoc.report.reading import read_run


def test_a_whole_run_is_read_from_its_calibration(whole):
    run = read_run(whole)
    assert (run.name, run.folder, run.method, run.groups["body_mass.leg"]) == (
        "whole",
        whole / "calibration",
        "madoc",
        1,
    )
    assert run.log.metrics["accuracy_sas"].tolist()[-3:] == [0.7, 0.7, 0.7]
    assert np.isnan(run.log.metrics["accuracy_sas"][:2]).all()
    assert run.embeddings.vectors.shape == (4, 16)


def test_a_whole_run_is_read_before_its_calibration_begins(tmp_path):
    write_json(tmp_path / "spec.json", {"command": "run", "name": "hopper", "data": "/logs/hopper.npz"})
    run = read_run(tmp_path)
    assert run.result is None and "/logs/hopper.npz" in run.spec_text


def test_a_run_under_way_is_read_up_to_its_last_whole_line(bare):
    (bare / "result.json").unlink()
    line = '{"control_steps": 10, "seconds": 1.0, "stage": "searching", "metrics": {"cost": null}}\n'
    (bare / "metrics.jsonl").write_text(line + '{"control_st')
    run = read_run(bare)
    assert run.result is None and len(run.log) == 1 and np.isnan(run.log.metrics["cost"][0])


def test_units_of_signals_come_from_the_spec_of_a_robot_of_ones_own(bare):
    spec = "signals:\n- {name: tilt, reads: position(hinge), unit: rad}\n- {name: tip, reads: 'sensor(tip)[0]'}\n"
    write_json(bare / "spec.json", {"command": "calibrate", "robot": {"file": "arm.yaml", "spec": spec}})
    assert read_run(bare).units == {"tilt": "rad"}


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("spec.json", b"[1]", "expected a JSON object in .*spec.json, got list"),
        ("result.json", b"{", "result.json is not valid JSON"),
        ("spec.json", b'{"seed": "one"}', "spec.json is damaged .seed: Input should be a valid integer"),
        ("metrics.jsonl", b"{\n{}\n", "metrics.jsonl, line 1, is not JSON"),
        ("evidence.npz", b"PK\x03\x04 no", "evidence.npz as npz .*is damaged.*restore it or delete it"),
        ("embeddings.npz", b"", "embeddings.npz is empty; copy or download it again"),
    ],
)
def test_a_damaged_file_is_named(bare, file, content, message):
    (bare / file).write_bytes(content)
    with pytest.raises(MadocError, match=message):
        read_run(bare)


@pytest.mark.parametrize("place", ["in the packed bytes", "in the directory"])
def test_flipped_bytes_in_a_compressed_array_are_told_of(bare, place):
    path = bare / "evidence.npz"
    np.savez_compressed(path, signals=np.array(["a"]), scale=np.ones(1))
    content = bytearray(path.read_bytes())
    if place == "in the packed bytes":
        # behind the 30 bytes of a member's header, its name and its extra field: a block of the reserved type 3
        content[30 + int.from_bytes(content[26:28], "little") + int.from_bytes(content[28:30], "little")] |= 0b110
    else:
        content[content.index(b"PK\x01\x02") + 10] = 99  # a way of packing that there is not
    path.write_bytes(content)
    with pytest.raises(MadocError, match=r"cannot read .*evidence.npz as npz .*restore it or delete it"):
        read_run(bare)


def test_an_npz_without_its_arrays_is_named(bare):
    np.savez(bare / "evidence.npz", signals=np.array(["a"]))
    with pytest.raises(MadocError, match=r"expected the array scale in .*evidence.npz, got signals"):
        read_run(bare)


def test_what_is_no_run_is_refused(tmp_path, bare):
    with pytest.raises(MadocError, match="there is no run folder"):
        read_run(tmp_path / "nowhere")
    with pytest.raises(MadocError, match="holds no calibration"):
        read_run(tmp_path)
    write_json(bare / "spec.json", {"command": "learn"})
    with pytest.raises(MadocError, match="holds a policy, not a calibration"):
        read_run(bare)
