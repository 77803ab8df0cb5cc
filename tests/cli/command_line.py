"""Command lines small enough for tests, run in this process or in one of their own."""

import json
import os
import subprocess
import sys
from pathlib import Path

from madoc.commands.answer import EXIT_CODES
from madoc.commands.main import main

SOURCE = Path(__file__).parents[2] / "src"

HYPERPARAMETERS = [
    *("updates=2", "epoch_steps=500", "replay_capacity=2000", "hidden=[16,16]", "cloning_epochs=2"),
    *("regression_hidden=[16]", "regression_epochs=2", "regression_updates=20"),
]

CALIBRATION = [
    *("--method", "madoc-s", "--budget", "2000", "--quiet"),
    *("--set", *HYPERPARAMETERS, "--set", "agents.hidden=[16]", "agents.batch=32"),
]

LEARNER = ["warmup_steps=500", "updates_per_step=0.01", "epoch_steps=500", "hidden=[16,16]", "replay_capacity=2000"]

FAST_LEARNER = ["warmup_steps=500", "steps_per_update=100", "epoch_steps=500", "hidden=[16,16]", "replay_capacity=2000"]

LEARNING = ["--budget", "1000", "--quiet", "--set", *LEARNER]

WHOLE = [
    *("run", "hopper-medium", "--transitions", "500", "--policy-budget", "1000", "--episodes", "2"),
    *("--draws", "4"),
    *CALIBRATION,
    *("--policy-set", *FAST_LEARNER),
]

WHOLE_CODE = EXIT_CODES["NO_IMPROVEMENT"]
"""Exit code of that run: 2,000 control steps of `madoc-s` are too few."""


def arguments(line, **paths):
    """A line of words, with {names} replaced by paths."""
    return [word.format(**paths) if "{" in word else word for word in line.split()]


def asked_for_json(capsys, words):
    """The one JSON object that a command prints, and its exit code."""
    code = main([*map(str, words), "--json"])
    told = capsys.readouterr().out
    assert told.count("\n") == 1
    return json.loads(told), code


def start(words, **options):
    """A command in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "madoc", *map(str, words)],
        env=os.environ | {"PYTHONPATH": str(SOURCE), "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def without_seconds(value):
    """JSON without what differs between two runs of the same thing: seconds and the folder."""
    if isinstance(value, dict):
        differing = ("seconds", "judging_seconds", "folder")
        return {name: without_seconds(child) for name, child in value.items() if name not in differing}
    return [without_seconds(child) for child in value] if isinstance(value, list) else value
