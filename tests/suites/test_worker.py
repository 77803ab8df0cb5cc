import json
import os
import shutil
import threading
from dataclasses import replace

import pytest

from madoc.errors import MadocError, NotAllowed
from madoc.pipeline.orders import Permission
from madoc.runs import machine
from madoc.runs.checkpoint import OtherState
from madoc.suites import worker
from madoc.suites.cells import Cell, write_plan
from madoc.suites.claims import MOST_ATTEMPTS, attempts_of, claimed, outcome_of, try_again
from madoc.suites.planning import plan_of
from madoc.suites.standing import Standing
from madoc.suites.worker import work
from robots import CELL


@pytest.fixture
def planned(suite, place):
    """A function that plans a suite in the folder `out`: that folder, and the cells."""

    def plan(text, **options):
        cells = plan_of(suite(text), **options).cells
        write_plan(place / "out", "suite", cells)
        return place / "out", cells

    return plan


def test_a_worker_does_every_cell_once(planned):
    out, cells = planned(CELL + "    grid: {seed: 0..1}\n")
    assert [outcome.status for outcome in work(out)] == ["finished", "finished"]
    assert work(out) == []
    for cell, fresh in zip(cells, (True, False), strict=True):
        assert outcome_of(cell, out).fresh is fresh
        assert json.loads((cell.folder(out) / "result.json").read_text())["seed"] == cell.read().search.seed


def test_a_policy_is_evaluated_with_its_calibration(place, monkeypatch):
    out, asked = place / "out", []
    policy = Cell("policy", "learn", {"method": "sac"}, "calibration")
    evaluation = Cell("evaluation", "evaluate", {"episodes": 3}, "policy")
    write_plan(out, "suite", [Cell("calibration", "calibrate", {}), policy, evaluation])
    monkeypatch.setattr(worker, "_require_unchanged", lambda *asked, **options: None)
    monkeypatch.setattr(worker, "evaluate_folder", lambda *places, **told: asked.append((places[0], told)) or places[1])
    with claimed(evaluation, out) as claim:
        assert worker.carry_out(claim, out).status == "finished"
    ((folder, told),) = asked
    assert (folder, told["calibration"]) == (policy.folder(out), out / "cells" / "calibration")


def test_a_refusal_is_kept_with_its_sentence_and_others_go_on(planned):
    out, (refused, done) = planned(CELL + "    grid: {velocities: [differences, logged]}\n")
    assert [outcome.status for outcome in work(out)] == ["refused", "finished"]
    assert "velocities" in outcome_of(refused, out).sentence
    assert outcome_of(done, out).usable


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system knows no affinity")
def test_a_user_without_a_name_takes_a_core(tmp_path, monkeypatch):
    taken = []
    monkeypatch.setattr(machine, "_held", [])
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)
    for name in ("LOGNAME", "USER", "LNAME", "USERNAME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {2, 3})
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, cores: taken.append(cores))
    machine.take_core()
    assert taken == [{2}]


@pytest.mark.parametrize("change", ["a range", "a mistake", "another log", "no log"])
def test_what_has_changed_since_it_was_planned_stands_under_no_old_name(planned, place, change):
    out, (cell,) = planned(CELL)
    spec = (place / "spring.yaml").read_text()
    match change:
        case "a range":
            (place / "spring.yaml").write_text(spec.replace("high: ", "high: 1"))
        case "a mistake":
            (place / "spring.yaml").write_text(spec.replace("high: ", "hgih: "))
        case "another log":
            shutil.copy(place / "other.npz", place / "log.npz")
        case "no log":
            (place / "log.npz").unlink()
    assert [outcome.status for outcome in work(out)] == ["failed"]
    assert outcome_of(cell, out).sentence.startswith("since this cell was planned a file that it names has changed")
    assert not (cell.folder(out) / "spec.json").exists()


@pytest.mark.parametrize(("error", "status"), [(OtherState, "failed"), (MadocError, "refused")])
def test_a_checkpoint_of_another_version_is_no_refusal(planned, monkeypatch, error, status):
    out, (cell,) = planned(CELL)

    def calibrate_in(*arguments, **options):
        raise error("a sentence")

    monkeypatch.setattr(worker, "calibrate_in", calibrate_in)
    assert [outcome.status for outcome in work(out)] == [status]
    assert outcome_of(cell, out).sentence == "a sentence"


def test_only_one_of_two_claims_gets_a_cell(planned):
    out, (cell,) = planned(CELL)
    with claimed(cell, out) as first, claimed(cell, out) as second:
        assert first is not None
        assert second is None
    with claimed(cell, out) as later:
        assert later.attempts == 2  # it was begun before, and got nowhere


def test_two_workers_that_race_for_every_cell_do_each_once(planned, monkeypatch):
    out, cells = planned(CELL + "    grid: {seed: 0..199}\n")
    barrier, done = threading.Barrier(2), []

    def quick(claim, suite, **options):
        done.append(claim.cell.name)
        return claim.end("finished", "done", 0.0)

    def race():
        barrier.wait()
        work(out)

    monkeypatch.setattr("madoc.suites.worker.carry_out", quick)
    threads = [threading.Thread(target=race) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(done) == sorted(cell.name for cell in cells)


def test_a_cell_that_never_gets_further_fails_in_the_end(planned, monkeypatch):
    out, (cell,) = planned(CELL)
    for _ in range(MOST_ATTEMPTS):
        with claimed(cell, out) as claim:
            assert claim is not None  # and its process ends without a word
    assert [outcome.status for outcome in work(out)] == ["failed"]
    assert try_again(cell, out)
    assert [outcome.status for outcome in work(out)] == ["finished"]
    assert not try_again(cell, out)


def test_a_cell_that_ends_its_processes_comes_after_the_others(planned):
    out, (first, second) = planned(CELL + "    grid: {seed: 0..1}\n")
    for _ in range(3):
        with claimed(first, out) as claim:
            assert claim is not None
    work(out)
    assert outcome_of(second, out).fresh
    assert (outcome_of(first, out).fresh, outcome_of(first, out).attempts) == (False, 4)


def test_an_error_that_is_no_refusal_is_told_and_stops_nobody(planned, monkeypatch):
    out, cells = planned(CELL + "    grid: {seed: 0..1}\n")
    whole = worker.calibrate_in

    def broken(folder, order, **options):
        if order.search.seed == 0:
            raise ZeroDivisionError("division by zero")
        return whole(folder, order, **options)

    monkeypatch.setattr(worker, "calibrate_in", broken)
    assert [outcome.status for outcome in work(out)] == ["failed", "finished"]
    assert "ZeroDivisionError: division by zero" in outcome_of(cells[0], out).sentence
    assert "Traceback" in (cells[0].folder(out) / "failure.txt").read_text()


def test_blocked_cells_wait_and_vain_ones_are_left(planned):
    out, (cell,) = planned(CELL)
    needing = replace(cell, name="needing", kind="learn", order={"method": "bc"}, needs=cell.name)
    last = replace(needing, name="last", needs="needing")
    write_plan(out, "suite", (cell, needing, last))
    with claimed(cell, out) as claim:
        claim.end("refused", "no", 0.0)
    standing = Standing(out, (cell, needing, last), workers=1)
    assert standing.runnable == []
    assert standing.counts == {"refused": 1, "not run": 2}
    assert work(out) == []


def test_a_worker_leaves_code_to_those_that_are_allowed_to_run_it(planned, place):
    (place / "plain.yaml").write_text((place / "spring.yaml").read_text())
    with (place / "spring.yaml").open("a") as spec:
        spec.write("python: task.py\n")
    (place / "task.py").write_text("def reward(place): return -abs(place)\n")
    with pytest.raises(MadocError, match=r"the spec names the Python file task.py"):
        planned(CELL)
    other = CELL.replace("spring.yaml", "plain.yaml")
    out, (cell, plain) = planned(CELL + other, permission=Permission(allow_code=True))
    with pytest.raises(NotAllowed, match="pass --allow-code"):
        work(out)
    assert outcome_of(cell, out) is None
    assert attempts_of(cell, out) == 0
    assert outcome_of(plain, out).usable  # what needs no code is done all the same
    assert [outcome.status for outcome in work(out, permission=Permission(allow_code=True))] == ["finished"]


def test_a_worker_of_one_plan_leaves_the_cells_of_the_others(planned, place, monkeypatch):
    out, (first, second) = planned(CELL + "    grid: {seed: 0..1}\n")
    write_plan(out, "another", [second])
    monkeypatch.setattr("madoc.suites.worker.carry_out", lambda claim, *_, **__: claim.end("finished", "done", 0.0))
    assert len(work(out, plan="another")) == 1
    assert outcome_of(first, out) is None
    with pytest.raises(MadocError, match=r"unknown plan of .* 'anothr'; did you mean another"):
        work(out, plan="anothr")
