"""Suites on real Ray clusters, in processes of their own."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from madoc.commands.main import main
from madoc.suites import executors
from madoc.suites.cells import write_plan
from madoc.suites.claims import claimed, outcome_of
from madoc.suites.planning import plan_of
from robots import CELL

ROOT = Path(__file__).parents[2]
with_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="the extra ray is not installed")


def test_a_task_does_its_cell_and_no_other_and_says_when_another_process_has_it(suite, place, monkeypatch):
    monkeypatch.setattr("madoc.suites.executors.prepare_worker", lambda: None)
    monkeypatch.setattr(executors, "_WAIT", 0.01)
    cells = plan_of(suite(CELL + "    grid: {seed: 0..1}\n")).cells
    write_plan(place / "out", "suite", cells)
    with claimed(cells[1], place / "out"):
        monkeypatch.setattr(executors.time, "sleep", lambda seconds: None)
        assert executors.do_cell(str(place / "out"), cells[1].name, "suite") == ""
    assert executors.do_cell(str(place / "out"), cells[0].name, "suite") == "finished"
    assert outcome_of(cells[1], place / "out") is None


@with_ray
@pytest.mark.slow
def test_a_cluster_for_one_suite_leaves_nothing_behind(suite, place, tmp_path):
    home, temporary = tmp_path / "home", Path(os.environ.get("TMPDIR", "/tmp"))
    home.mkdir()
    before = set(temporary.glob("*ray*"))
    words = ["suite", suite(CELL + "    grid: {seed: 0..2}\n"), "--out", place / "out", "--executor", "ray", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "madoc", *map(str, words), "--workers", "2", "--quiet"],
        env=os.environ | {"HOME": str(home), "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["ended"] == {"finished": 3}
    assert [path.name for path in home.iterdir()] == [".cache"]  # compiled code and the locks of cores
    assert set(temporary.glob("*ray*")) == before


def test_a_cluster_that_is_not_there_is_one_sentence(suite, place, capsys):
    words = ["suite", suite(CELL), "--out", place / "out", "--executor", "ray", "--address", "127.0.0.1:1"]
    assert main([str(word) for word in words]) == 2
    assert "there is no Ray cluster at 127.0.0.1:1: Connection refused" in capsys.readouterr().err
