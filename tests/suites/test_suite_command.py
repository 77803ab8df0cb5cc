"""`madoc suite` and `madoc worker` as a user sees them, with workers in processes of their own."""

import csv
import json

import pytest

from madoc.commands.main import main
from madoc.suites.cells import write_plan
from madoc.suites.claims import claimed
from madoc.suites.planning import plan_of
from madoc.suites.worker import work
from robots import CELL


def told(capsys, *words):
    code = main([*map(str, words), "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_from_plan_to_report(suite, place, capsys):
    file, out = suite(CELL + "    grid: {seed: 0..1, velocities: [logged, differences]}\n"), place / "out"
    code, listed = told(capsys, "suite", file, "--out", out, "--dry-run")
    assert (code, listed["left"], listed["seconds_left"]) == (0, 4, None)
    assert [cell["status"] for cell in listed["cells"]] == ["not run"] * 4
    assert not out.exists()
    code, planned = told(capsys, "suite", file, "--out", out, "--workers", 0)
    assert (code, planned["left"]) == (0, 4)
    work(out, [plan_of(file).cells[0].name, plan_of(file).cells[1].name])
    code, listed = told(capsys, "suite", file, "--out", out, "--dry-run")
    assert [cell["status"] for cell in listed["cells"]] == ["finished", "refused", "not run", "not run"]
    assert listed["seconds_left"] > 0
    code, reported = told(capsys, "suite", file, "--out", out, "--report", "--parquet")
    assert reported["ended"] == {"finished": 1, "refused": 1, "not run": 2}
    rows = list(csv.DictReader((out / "suite.csv").read_text().splitlines()))
    assert [row["status"] for row in rows] == ["finished"] * 3 + ["refused"] + ["not run"] * 2
    assert {row["parameter"] for row in rows[:3]} == {"jnt_stiffness.slide", "dof_damping.slide", "body_mass.cart"}
    assert all(float(row["low"]) <= float(row["interval_low"]) <= float(row["estimate"]) for row in rows[:3])
    pyarrow = pytest.importorskip("pyarrow.parquet", reason="the extra logs is not installed")
    assert pyarrow.read_table(out / "suite.parquet").num_rows == len(rows)
    page = (out / "suite.html").read_text()
    assert "2 cells were not run: <code>madoc suite" in page
    assert page.count("<tr>") >= 6


def test_a_suite_starts_its_workers_and_more_seeds_repeat_nothing(suite, place, capsys):
    out, (foreign,) = place / "out", plan_of(suite(CELL + "    seed: 9\n", "another.yaml")).cells
    write_plan(out, "another", [foreign])
    file = suite(CELL + "    grid: {seed: 0..1}\n")
    code, ended = told(capsys, "suite", file, "--out", out, "--workers", 1, "--quiet")
    assert (code, ended["ended"]) == (0, {"finished": 2})
    assert not foreign.folder(out).exists()  # a cell of another suite that shares the folder
    before = {path: path.stat().st_mtime_ns for path in out.glob("cells/*/outcome.json")}
    file = suite(CELL + "    grid: {seed: 0..2}\n")
    with claimed(plan_of(file).cells[2], out) as claim:
        claim.end("finished", "done by another", 0.0)
    assert told(capsys, "suite", file, "--out", out, "--quiet")[1]["ended"] == {"finished": 3}
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_the_command_for_the_report_may_run_code_where_the_suite_may(suite, place, capsys):
    file, out = suite(CELL), place / "out"
    with claimed(plan_of(file).cells[0], out) as claim:
        claim.end("finished", "done by another", 0.0)
    words = ["suite", str(file), "--out", str(out)]
    assert main(words) == 0
    assert f"report: madoc suite {file} --out {out} --report\n" in capsys.readouterr().out
    assert main([*words, "--allow-code"]) == 0
    assert f"report: madoc suite {file} --out {out} --report --allow-code\n" in capsys.readouterr().out


def test_a_worker_needs_a_plan(place, capsys, monkeypatch):
    monkeypatch.setattr("madoc.runs.machine.take_core", lambda: None)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(place))
    assert main(["worker", str(place)]) == 2
    assert "there is no plan of a suite" in capsys.readouterr().err


def test_ray_that_is_not_installed_is_told_of(suite, place, capsys, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    assert main(["suite", str(suite(CELL)), "--out", str(place / "out"), "--executor", "ray"]) == 2
    assert 'pip install "madoc-calibration[ray]"' in capsys.readouterr().err
