"""`auto` killed at any moment and resumed ends with the same bits as one that was not."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import pytest

from comparing import TINY, listed
from madoc import data
from madoc.data import Disturbance, disturb
from robots import SPRING_TRUTH, recorded

TESTS = Path(__file__).parents[1]


def start(words, cache):
    environment = {"PYTHONPATH": os.pathsep.join([str(TESTS), str(TESTS.parent / "src")]), "JAX_PLATFORMS": "cpu"}
    return subprocess.Popen(
        [sys.executable, TESTS / "comparing.py", *map(str, words)],
        env=os.environ | environment | {"JAX_COMPILATION_CACHE_DIR": str(cache)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def without_seconds(value):
    if isinstance(value, dict):
        differing = ("seconds", "peak_memory")
        return {name: without_seconds(child) for name, child in value.items() if name not in differing}
    return [without_seconds(child) for child in value] if isinstance(value, list) else value


def told(folder):
    files = ("result.json", "comparison.json", "least-squares/result.json", "madoc-local/result.json")
    found = {name: without_seconds(json.loads((folder / name).read_text())) for name in files}
    return found | {"evidence": (folder / "evidence.npz").read_bytes()}


@pytest.mark.slow
def test_killed_and_resumed_equals_uninterrupted(tmp_path):
    # A wrong fixed parameter: no candidate explains all, so both run.
    task = listed("legacy")
    log = disturb(recorded(task, SPRING_TRUTH, 500, jax.random.key(1)), Disturbance(noise=0.1), task, jax.random.key(2))
    data.save(log, tmp_path / "spring.npz")
    words = [
        "calibrate",
        "spring",
        "--data",
        tmp_path / "spring.npz",
        "--method",
        "auto",
        "--budget",
        30_000,
        "--quiet",
    ]
    words += ["--parameters", "jnt_stiffness.slide", "dof_damping.slide", "--set", *TINY]
    cache = tmp_path / "cache"
    whole = start([*words, "--out", tmp_path / "whole"], cache)
    _, err = whole.communicate(timeout=250)
    assert whole.returncode == 12, err
    run = tmp_path / "run"
    for waits_for in ("spec.json", "least-squares/result.json", "comparison.json", "madoc-local/metrics.jsonl"):
        process = start([*words, "--out", run, *(["--resume"] if (run / "spec.json").exists() else [])], cache)
        while not (run / waits_for).exists() and process.poll() is None:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert not (run / "result.json").exists()
    last = start([*words, "--out", run, "--resume"], cache)
    _, err = last.communicate(timeout=250)
    assert last.returncode == 12, err
    assert told(run) == told(tmp_path / "whole")
