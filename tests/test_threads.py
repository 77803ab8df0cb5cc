"""The number of cores decides how long a calibration takes, never what it finds."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from madoc.runs.machine import choosable_cores

TESTS = Path(__file__).parent
CORES = choosable_cores()


def calibrated_on(cores):
    folders = [str(TESTS), str(TESTS.parent / "src")]
    plain = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run(
        ["taskset", "--cpu-list", ",".join(map(str, cores)), sys.executable, str(TESTS / "calibrating.py"), "wide"],
        env=plain | {"PYTHONPATH": os.pathsep.join(folders), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.skipif(len(CORES) < 2, reason="this machine has one core, or none to choose")
def test_same_seed_same_result_at_one_and_two_threads():
    one, two = calibrated_on(CORES[:1]), calibrated_on(CORES[:2])
    assert (one["threads"], two["threads"]) == (1, 2)
    assert one["mean"] == two["mean"]
