"""A calibration killed at any moment and resumed ends with the same bits as one that was not."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import pytest

from madoc.commands.answer import EXIT_CODES
from madoc.data import save
from madoc.robots import load
from own_robots import SPRING_SPEC, write_robot
from robots import SPRING_TRUTH, recorded

TESTS = Path(__file__).parents[1]
SMALL = [
    *("draws=8", "horizon=5", "epochs=2", "hidden=[8]", "fitting_epochs=2", "updates=5", "batch=16", "samples=50"),
    *("replay_capacity=300", "flow_layers=1", "flow_width=4", "flow_updates=8", "cloning_epochs=5"),
]
VERDICTS = tuple(EXIT_CODES.values())


def start(words):
    folders = [str(TESTS), str(TESTS.parent / "src")]
    return subprocess.Popen(
        [sys.executable, *map(str, words)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(folders), "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process, codes=(0,)):
    """The exit code of a process that nobody kills."""
    _, err = process.communicate(timeout=250)
    assert process.returncode in codes, err
    return process.returncode


def epochs(folder):
    file = folder / "metrics.jsonl"
    return file.read_bytes().count(b"\n") if file.exists() else 0


def kill_after(process, *, folder, more, seconds):
    """Kill a run so many seconds after it has gone on by so many epochs."""
    goal = epochs(folder) + more
    while epochs(folder) < goal and process.poll() is None:
        time.sleep(0.005)
    time.sleep(seconds)
    process.send_signal(signal.SIGKILL)
    _, err = process.communicate()
    assert process.returncode == -signal.SIGKILL, f"the run ended before it was killed {err}"


def told(folder):
    result = json.loads((folder / "result.json").read_text())
    del result["seconds"]
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return result, [(line["stage"], line["control_steps"], line["metrics"]) for line in lines]


@pytest.mark.parametrize("kills", [1, pytest.param(20, marks=pytest.mark.slow)])
def test_killed_and_resumed_equals_uninterrupted(tmp_path, kills):
    moments = random.Random(kills)
    budget = 100 * (20 + 40 * kills)
    run = tmp_path / "run"
    ended(start([TESTS / "calibrating.py", tmp_path / "whole", budget]))
    for kill in range(kills):
        process = start([TESTS / "calibrating.py", run, budget])
        # Some moments fall before the first epoch: into imports, into the making of the folder.
        more = 0 if kill % 7 == 6 else 1
        kill_after(process, folder=run, more=more, seconds=moments.uniform(0.0, 0.3 if more else 5.0))
        assert not (run / "result.json").exists()
    ended(start([TESTS / "calibrating.py", run, budget]))
    assert told(run) == told(tmp_path / "whole")
    assert {path.name for path in run.iterdir()} == {path.name for path in (tmp_path / "whole").iterdir()}


@pytest.mark.slow
def test_the_command_line_too(tmp_path):
    """With `auto`, which takes npe of a robot that shows its speed alone, and a verdict in the end."""
    spec = SPRING_SPEC.replace("  - {name: place, reads: position(slide)}\n", "") + "max_episode_steps: 100\n"
    robot, data = write_robot(tmp_path, spec), tmp_path / "log.npz"
    save(recorded(load(robot).task, SPRING_TRUTH, 1000, jax.random.key(0)), data)
    words = ["-m", "madoc", "calibrate", robot, "--data", data, "--budget", 6_000, "--quiet"]
    words += ["--set", *(f"npe.{setting}" for setting in SMALL)]
    code = ended(start([*words, "--out", tmp_path / "whole"]), VERDICTS)
    process = start([*words, "--out", tmp_path / "run"])
    kill_after(process, folder=tmp_path / "run", more=20, seconds=0.1)
    assert ended(start([*words, "--out", tmp_path / "run", "--resume"]), VERDICTS) == code
    assert told(tmp_path / "run") == told(tmp_path / "whole")
    assert told(tmp_path / "run")[0]["chosen"].startswith("auto took npe")
