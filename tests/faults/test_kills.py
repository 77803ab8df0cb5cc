"""A calibration killed at any moment and resumed ends with the same bits as one that was not."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from madoc.commands.answer import EXIT_CODES

TESTS = Path(__file__).parents[1]
SMALL = [
    *("updates=5", "epoch_steps=500", "hidden=[16]", "agents.hidden=[16]", "patience=0", "cloning_epochs=5"),
    *("regression_hidden=[16]", "regression_epochs=5", "regression_updates=20"),
]


def start(words, **environment):
    folders = [str(TESTS), str(TESTS.parent / "src")]
    return subprocess.Popen(
        [sys.executable, *map(str, words)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(folders), "JAX_PLATFORMS": "cpu"} | environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process, code=0):
    """Wait for a process that nobody kills."""
    _, err = process.communicate(timeout=250)
    assert process.returncode == code, err


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
    # What the uninterrupted run compiles is kept for the others, for speed; the command line below compiles anew.
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache")}
    cache |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0", "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1"}
    ended(start([TESTS / "calibrating.py", tmp_path / "whole", budget], **cache))
    for kill in range(kills):
        process = start([TESTS / "calibrating.py", run, budget], **cache)
        # Some moments fall before the first epoch: into imports, into the making of the folder.
        more = 0 if kill % 7 == 6 else 1
        kill_after(process, folder=run, more=more, seconds=moments.uniform(0.0, 0.3 if more else 5.0))
        assert not (run / "result.json").exists()
    ended(start([TESTS / "calibrating.py", run, budget], **cache))
    assert told(run) == told(tmp_path / "whole")
    assert {path.name for path in run.iterdir()} == {path.name for path in (tmp_path / "whole").iterdir()}


@pytest.mark.slow
def test_the_command_line_too(tmp_path):
    """With `auto`, which takes Madoc where next observations are shuffled, and a verdict in the end."""
    data, rejected = tmp_path / "hopper.npz", EXIT_CODES["DATA_REJECTED"]
    ended(start(["-m", "madoc", "record", "hopper-medium", "--transitions", 2000, "--out", data, "--quiet"]))
    words = ["-m", "madoc", "calibrate", "hopper", "--data", data, "--budget", 60_000, "--quiet"]
    words += ["--shuffle", "next_observations", "--set", *(f"madoc.{setting}" for setting in SMALL)]
    ended(start([*words, "--out", tmp_path / "whole"]), rejected)
    process = start([*words, "--out", tmp_path / "run"])
    kill_after(process, folder=tmp_path / "run", more=20, seconds=0.1)
    ended(start([*words, "--out", tmp_path / "run", "--resume"]), rejected)
    assert told(tmp_path / "run") == told(tmp_path / "whole")
    assert told(tmp_path / "run")[0]["chosen"].startswith("auto took madoc")
