import json
import subprocess
import sys

import pytest

from madoc.errors import MadocError
from madoc.runs.run_folder import RunFolder

SPEC = {
    "method": "madoc",
    "hyperparameters": {"rate": 0.1, "layers": (2, 2)},
    "data": "a.h5",
    "seed": 0,
    "budget": 9,
}


def test_a_spec_is_kept_with_versions(tmp_path):
    with RunFolder.create(tmp_path / "deep/run", SPEC) as folder:
        assert folder.spec["seed"] == 0
    spec = json.loads((tmp_path / "deep/run/spec.json").read_text())
    assert spec["versions"].keys() == {"python", "madoc", "jax", "mujoco"}
    assert spec["hyperparameters"]["layers"] == [2, 2]
    with RunFolder.open(tmp_path / "deep/run", SPEC) as folder:
        assert folder.spec == spec


def test_a_folder_with_a_run_is_refused_without_resume(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    RunFolder.create(tmp_path, SPEC).close()
    with pytest.raises(MadocError, match="already holds a run; pass --resume to go on or choose another --out"):
        RunFolder.create(tmp_path, SPEC)
    RunFolder.open(tmp_path).close()  # the refusal left no lock


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"method": "vdn"}, 'method was "madoc", is now "vdn"'),
        ({"hyperparameters": {"rate": 0.2, "layers": [2, 2]}}, "hyperparameters.rate was 0.1, is now 0.2"),
        ({"hyperparameters": {"layers": [2, 2]}}, "hyperparameters.rate was 0.1, is now not given"),
        ({"seed": 1}, "seed was 0, is now 1"),
        ({"task": "hopper"}, 'task was not given, is now "hopper"'),
    ],
)
def test_another_spec_is_refused_by_key(tmp_path, change, words):
    RunFolder.create(tmp_path, SPEC).close()
    with pytest.raises(MadocError, match=words):
        RunFolder.open(tmp_path, SPEC | change)
    RunFolder.open(tmp_path, SPEC).close()


def test_another_budget_is_taken_and_other_versions_are_noted(tmp_path):
    RunFolder.create(tmp_path, SPEC).close()
    with RunFolder.open(tmp_path, SPEC | {"budget": 99}) as folder:
        assert folder.spec["budget"] == 99
    spec = json.loads((tmp_path / "spec.json").read_text())
    assert spec["budget"] == 99
    spec["versions"]["jax"] = "0.1"
    (tmp_path / "spec.json").write_text(json.dumps(spec))
    with pytest.warns(UserWarning, match=r"was started with jax 0\.1 \(now "):
        RunFolder.open(tmp_path, SPEC).close()


def test_nothing_to_resume(tmp_path):
    with pytest.raises(MadocError, match="does not exist; check the path, or leave out --resume"):
        RunFolder.open(tmp_path / "missing")
    assert not (tmp_path / "missing").exists()
    with pytest.raises(MadocError, match="holds no run"):
        RunFolder.open(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(MadocError, match="could not make the folder"):
        RunFolder.create(tmp_path / "file", SPEC)


def test_a_damaged_spec_is_refused_and_unlocks(tmp_path):
    (tmp_path / "spec.json").write_text("{")
    for _ in range(2):
        with pytest.raises(MadocError, match="is not valid JSON"):
            RunFolder.open(tmp_path)


def test_a_locked_folder_is_refused(tmp_path):
    with RunFolder.create(tmp_path, SPEC):
        with pytest.raises(MadocError, match="in use by another process"):
            RunFolder.open(tmp_path)
        program = f"from madoc.runs.run_folder import RunFolder; RunFolder.open({str(tmp_path)!r})"
        other = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
        assert "is in use by another process; wait until it ends" in other.stderr
    RunFolder.open(tmp_path).close()


def test_leftovers_of_a_killed_writer_are_cleared(tmp_path):
    RunFolder.create(tmp_path, SPEC).close()
    (tmp_path / ".checkpoint.npz.17.tmp").write_bytes(b"half")
    RunFolder.open(tmp_path).close()
    assert not (tmp_path / ".checkpoint.npz.17.tmp").exists()
