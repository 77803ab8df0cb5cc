import json
import os
import random
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from madoc.errors import MadocError
from madoc.runs import checkpoint
from madoc.runs.budget import Seconds
from madoc.runs.loop import Tally, run
from madoc.runs.run_folder import RunFolder
from madoc.types import Epoch
from wandering import BUDGET, SPEC, Wander, bits

KEY = jax.random.key(0)


def lines(path):
    text = (path / "metrics.jsonl").read_text()
    assert text.endswith("\n")
    return [json.loads(line) for line in text.splitlines()]


def without_seconds(path):
    return [{name: value for name, value in line.items() if name != "seconds"} for line in lines(path)]


def written(budget):
    """A budget as a spec has it."""
    return budget if isinstance(budget, int) else str(budget)


def in_folder(path, *, budget=BUDGET, method=None, resume=False, spec=SPEC, **options):
    with (RunFolder.open if resume else RunFolder.create)(path, spec | {"budget": written(budget)}) as folder:
        return run(
            method or Wander(),
            None,
            key=KEY,
            budget=budget,
            folder=folder,
            resume=resume,
            quiet=True,
            **options,
        )


def start(path, seconds):
    folders = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2] / "src")]
    inherited = [
        folder for folder in os.environ.get("PYTHONPATH", "").split(os.pathsep) if folder
    ]  # another MuJoCo, say
    return subprocess.Popen(
        [sys.executable, str(Path(__file__).parents[1] / "wandering.py"), str(path), str(seconds)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([*inherited, *folders]), "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for_lines(path, count, process):
    """Wait until metrics.jsonl has this many lines: a signal then falls into the run, not into imports."""
    for _ in range(6000):
        if (path / "metrics.jsonl").exists() and (path / "metrics.jsonl").read_bytes().count(b"\n") >= count:
            return
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    raise AssertionError("the run wrote nothing for a minute")


def test_same_seed_same_result_with_and_without_a_folder(tmp_path):
    alone = run(Wander(), None, key=KEY, budget=BUDGET, quiet=True)
    written = in_folder(tmp_path / "run")
    assert alone.status == written.status == "finished"
    assert alone.control_steps == written.control_steps == BUDGET
    assert alone.sentence == "the budget of 600 control steps is spent"
    assert bits(alone.state) == bits(written.state)
    other = run(Wander(), None, key=jax.random.key(1), budget=BUDGET, quiet=True)
    assert bits(other.state) != bits(alone.state)


def test_a_run_leaves_its_files(tmp_path):
    finished = in_folder(tmp_path / "run")
    found = {file.name for file in (tmp_path / "run").iterdir()} - {".lock", "memory.json"}  # that where it is known
    assert found == {"spec.json", "metrics.jsonl", "tensorboard", "checkpoint.npz", "result.json"}
    written = lines(tmp_path / "run")
    assert len(written) == 63
    assert written[0].keys() == {"control_steps", "seconds", "stage", "metrics"}
    assert [line["stage"] for line in written[:4]] == ["cloning", "cloning", "cloning", "learning"]
    assert [line["control_steps"] for line in written[:5]] == [0, 0, 0, 10, 20]
    result = json.loads((tmp_path / "run/result.json").read_text())
    assert result == {
        "status": "finished",
        "sentence": finished.sentence,
        "control_steps": BUDGET,
        "updates": 0,
        "seconds": finished.seconds,
    }
    events = list((tmp_path / "run/tensorboard").iterdir())
    assert len(events) == 1
    assert b"learning/mean" in events[0].read_bytes()


def test_a_larger_budget_goes_on_to_the_bits_of_an_uninterrupted_run(tmp_path):
    whole = in_folder(tmp_path / "whole")
    for budget in (10, 200, 590):
        in_folder(tmp_path / "split", budget=budget, resume=budget > 10)
    split = in_folder(tmp_path / "split", resume=True)
    assert bits(split.state) == bits(whole.state)
    assert without_seconds(tmp_path / "split") == without_seconds(tmp_path / "whole")
    assert json.loads((tmp_path / "split/spec.json").read_text())["budget"] == BUDGET
    seconds = [line["seconds"] for line in lines(tmp_path / "split")]
    assert seconds == sorted(seconds)
    assert len(list((tmp_path / "split/tensorboard").iterdir())) == 4


def test_resuming_a_finished_run_returns_it_untouched(tmp_path):
    first = in_folder(tmp_path / "run")
    files = [file for file in (tmp_path / "run").iterdir() if file.name != ".lock"]
    before = {file: file.stat().st_mtime_ns for file in files}
    again = in_folder(tmp_path / "run", resume=True)
    assert bits(again.state) == bits(first.state)
    assert (again.status, again.sentence, again.seconds) == (first.status, first.sentence, first.seconds)
    assert {file: file.stat().st_mtime_ns for file in files} == before


def test_a_result_lost_to_a_kill_is_written_on_resume(tmp_path):
    in_folder(tmp_path / "run")
    wanted = json.loads((tmp_path / "run/result.json").read_text())
    (tmp_path / "run/result.json").unlink()
    in_folder(tmp_path / "run", resume=True)
    assert json.loads((tmp_path / "run/result.json").read_text()) == wanted


def test_progress_counts_the_preparation_as_a_tenth():
    tally = Tally()
    assert tally.fraction(0.5) == 0.5
    half, ready = (tally.plus(Epoch(fraction=done)) for done in (0.5, 1.0))
    assert [half.fraction(0.0), ready.fraction(0.0), ready.fraction(0.5), ready.fraction(2.0)] == pytest.approx(
        [0.05, 0.1, 0.55, 1.0]
    )
    assert ready.plus(Epoch(control_steps=5, unbudgeted=2)).spent("control steps") == 3


def test_convergence_ends_a_run_before_its_budget(tmp_path):
    finished = in_folder(tmp_path / "run", method=Wander(converged_epoch=20))
    assert (finished.status, finished.sentence, finished.control_steps) == (
        "converged",
        "it stood still",
        170,
    )


@pytest.mark.parametrize("place", ["metric", "state"])
def test_a_nan_stops_the_run_and_leaves_good_and_bad_state(tmp_path, place):
    in_folder(tmp_path / "run", budget=100)
    good = bits(in_folder(tmp_path / "run", resume=True, budget=100).state)
    bad = Wander(bad_epoch=20, bad_place=place)
    every = 0.0 if place == "state" else 30.0
    finished = in_folder(tmp_path / "run", method=bad, resume=True, checkpoint_every=every)
    assert finished.status == "diverged"
    like = Wander().init(None, KEY)
    last, _ = checkpoint.load(tmp_path / "run/checkpoint.npz", like)
    dump, _ = checkpoint.load(tmp_path / "run/diverged.npz", like)
    assert checkpoint.first_non_finite(last) is None
    assert bits(finished.state) == bits(last)
    assert dump.epoch == 21
    assert json.loads((tmp_path / "run/result.json").read_text())["status"] == "diverged"
    if place == "metric":
        assert finished.sentence.startswith("stopped at 180 control steps: metric mean became nan while learning")
        assert bits(last) == good
        assert lines(tmp_path / "run")[-1]["metrics"] == {"mean": None, "epoch": 21.0}
    else:
        assert "state.position holds a NaN" in finished.sentence
        assert last.epoch == 20
    healed = in_folder(tmp_path / "run", resume=True)  # as after a repair of the method
    assert healed.status == "finished"
    assert bits(healed.state) == bits(run(Wander(), None, key=KEY, budget=BUDGET, quiet=True).state)
    assert not (tmp_path / "run/diverged.npz").exists()


def test_killed_again_and_again_ends_with_the_same_bits(tmp_path):
    whole = in_folder(tmp_path / "whole")
    moments = random.Random(0)
    done = 0
    for _ in range(4):
        process = start(tmp_path / "run", 0.01)
        wait_for_lines(tmp_path / "run", done + 1, process)
        time.sleep(moments.uniform(0.0, 0.1))
        process.kill()
        process.communicate()
        done = (tmp_path / "run/metrics.jsonl").read_bytes().count(b"\n")
        assert process.returncode == -signal.SIGKILL
        assert not (tmp_path / "run/result.json").exists()
    with (tmp_path / "run/metrics.jsonl").open("ab") as file:
        file.write(b'{"control_steps": 1')  # half a line
    (tmp_path / "run/.checkpoint.npz.1.tmp").write_bytes(b"half a checkpoint")
    resumed = in_folder(tmp_path / "run", resume=True)
    assert resumed.status == "finished"
    assert bits(resumed.state) == bits(whole.state)
    assert without_seconds(tmp_path / "run") == without_seconds(tmp_path / "whole")
    assert not list((tmp_path / "run").glob("*.tmp"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_leaves_a_folder_to_go_on_from(tmp_path, number):
    process = start(tmp_path / "run", 0.05)
    wait_for_lines(tmp_path / "run", 2, process)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out.strip()) == (0, "interrupted"), err
    _, extra = checkpoint.load(tmp_path / "run/checkpoint.npz", Wander().init(None, KEY))
    assert extra["metrics_bytes"] == (tmp_path / "run/metrics.jsonl").stat().st_size
    assert json.loads((tmp_path / "run/result.json").read_text())["status"] == "interrupted"
    resumed = in_folder(tmp_path / "run", resume=True)
    assert bits(resumed.state) == bits(run(Wander(), None, key=KEY, budget=BUDGET, quiet=True).state)


class Interrupts(Wander):
    """Sends itself signals inside its fifth step."""

    count = 1

    def step(self, problem, state):
        if state.epoch == 5:
            for _ in range(self.count):
                signal.raise_signal(signal.SIGINT)
        return super().step(problem, state)


class InterruptsTwice(Interrupts):
    count = 2


@pytest.mark.parametrize("method", [Interrupts(), InterruptsTwice()])
def test_the_first_interrupt_ends_the_step_and_the_second_breaks_it_off(tmp_path, method):
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    finished = in_folder(tmp_path / "run", method=method)
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
    assert finished.status == "interrupted"
    assert finished.state.epoch == (6 if method.count == 1 else 5)
    resumed = in_folder(tmp_path / "run", resume=True)
    assert bits(resumed.state) == bits(run(Wander(), None, key=KEY, budget=BUDGET, quiet=True).state)


def test_runs_outside_the_main_thread():
    results = []
    thread = threading.Thread(target=lambda: results.append(run(Wander(), None, key=KEY, budget=20, quiet=True)))
    thread.start()
    thread.join()
    assert results[0].status == "finished"


class Fails(Wander):
    def step(self, problem, state):
        if state.epoch == 5:
            raise MadocError("the robot fell over")
        return super().step(problem, state)


def test_an_error_in_a_step_closes_everything(tmp_path):
    with pytest.raises(MadocError, match="the robot fell over"):
        in_folder(tmp_path / "run", method=Fails())
    assert in_folder(tmp_path / "run", resume=True).status == "finished"


class Grows(Wander):
    def step(self, problem, state):
        state, epoch = super().step(problem, state)
        return type(state)(**{**vars(state), "sum": np.zeros(state.epoch)}), epoch


def test_a_state_that_changes_shape_is_refused_before_it_is_saved(tmp_path):
    with pytest.raises(MadocError, match=r"the method changed the layout of its state: expected state\.sum to be"):
        in_folder(tmp_path / "run", method=Grows(), checkpoint_every=0.0)


def test_refusals(tmp_path):
    with pytest.raises(MadocError, match="at least 1 control step, got 0"):
        run(Wander(), None, key=KEY, budget=0)
    with pytest.raises(MadocError, match="cannot resume without a run folder"):
        run(Wander(), None, key=KEY, budget=1, resume=True)
    with RunFolder.create(tmp_path / "run", SPEC) as folder:
        run(Wander(), None, key=KEY, budget=20, folder=folder, quiet=True)
        with pytest.raises(MadocError, match="already holds a run; pass --resume"):
            run(Wander(), None, key=KEY, budget=20, folder=folder, quiet=True)


def test_a_metrics_file_shorter_than_its_checkpoint_is_refused(tmp_path):
    in_folder(tmp_path / "run", budget=100)
    os.truncate(tmp_path / "run/metrics.jsonl", 10)
    with pytest.raises(MadocError, match="has 10 bytes, its checkpoint says"):
        in_folder(tmp_path / "run", resume=True)


def test_a_time_budget_is_kept_across_a_resume(tmp_path):
    slow = Wander(seconds=0.02)
    first = in_folder(tmp_path / "run", method=slow, budget=Seconds(0.2))
    assert (first.status, first.sentence) == ("finished", "the budget of 0.2 s is spent")
    assert 0.2 <= first.seconds < 5.0
    second = in_folder(tmp_path / "run", method=slow, budget=Seconds(first.seconds + 0.3), resume=True)
    assert second.status == "finished"
    assert second.seconds >= first.seconds + 0.3
    assert second.control_steps - first.control_steps <= 10 * (second.seconds - first.seconds) / 0.02 + 10


def test_a_step_that_would_outlast_the_time_is_not_begun(tmp_path):
    ahead = Wander(seconds=0.05, cloning=0, following=10_000)  # a thousand times the first step, of at least 0.05 s
    first = in_folder(tmp_path / "run", method=ahead, budget=Seconds(30.0))
    assert (first.status, first.control_steps) == ("finished", 10)
    words = r"\d+ of 30 s are spent, and too little is left for the next step, of about \S+ s; give it a larger budget"
    assert re.fullmatch(words, first.sentence)
    again = in_folder(tmp_path / "run", method=ahead, budget=Seconds(30.0), resume=True)
    assert (again.control_steps, again.sentence) == (first.control_steps, first.sentence)
    assert in_folder(tmp_path / "count", method=ahead, budget=30).control_steps == 30
    fits = Wander(seconds=0.05, cloning=0, following=10, converged_epoch=3)
    assert in_folder(tmp_path / "fits", method=fits, budget=Seconds(30.0)).status == "converged"
