"""An arm of hardware, where its logs are: named by the variable MADOC_SO101, or in shared/data beside the repository.
They are not Madoc's to copy."""

import importlib.util
import os
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("MADOC_SO101", ROOT.parent / "shared" / "data" / "so101"))
FOUND = {"stiffness": 13.168, "friction": 0.1289, "damping": 1.053, "rotor": 0.01709}
"""What the documentation's command found."""


@pytest.fixture(scope="module")
def benchmark():
    if not DATA.is_dir():
        pytest.skip("the logs of the SO-101 arm are not here; name their folder in MADOC_SO101")
    place = ROOT / "benchmarks" / "real_arm.py"
    sys.path.insert(0, str(place.parent))
    try:
        spec = importlib.util.spec_from_file_location("real_arm", place)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(place.parent))
    return module


def test_what_was_found_predicts_other_motions_better_than_the_published_model(benchmark, tmp_path):
    errors = benchmark.errors_of(benchmark.beside_model(DATA, tmp_path), DATA, FOUND)
    for motion, row in errors.items():
        assert row["madoc"] < 0.7 * row["published"], motion


def test_the_arm_is_calibrated(benchmark):
    found = benchmark.compare(DATA)
    for motion, share in found["share_of_published"].items():
        assert share < 0.7, motion
    low, high = found["parameters"]["stiffness"]["interval"]
    assert low < FOUND["stiffness"] < high
