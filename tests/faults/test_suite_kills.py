"""A suite whose workers are killed, and then the suite, ends with the bits of an undisturbed one."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HAS_RAY = importlib.util.find_spec("ray") is not None


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "executor",
    [
        "local",
        *(
            pytest.param(name, marks=pytest.mark.skipif(not HAS_RAY, reason="the extra ray is not installed"))
            for name in ("ray", "ray-nodes")
        ),
    ],
)
def test_every_result_has_the_bits_of_an_undisturbed_run(executor, tmp_path):
    words = [ROOT / "benchmarks" / "suite_faults.py", "--executor", executor, "--cells", 6, "--kills", 3]
    done = subprocess.run(
        [sys.executable, *map(str, words), "--results", str(tmp_path / "suite.jsonl")],
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    told = json.loads((tmp_path / "suite.jsonl").read_text())
    assert told["workers_killed"] > 0
    assert (told["results"], told["equal_bits"], told["workers_left_10_s_after"]) == (6, 6, 0)
