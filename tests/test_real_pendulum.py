"""A pendulum of hardware, where its logs are: named by the variable MADOC_PENDULUM, or in shared/data beside the
repository. They are not Madoc's to copy."""

import importlib.util
import os
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("MADOC_PENDULUM", ROOT.parent / "shared" / "data" / "dfki_simple_pendulum"))


@pytest.fixture(scope="module")
def compared():
    if not DATA.is_dir():
        pytest.skip("the logs of the DFKI pendulum are not here; name their folder in MADOC_PENDULUM")
    place = ROOT / "benchmarks" / "real_pendulum.py"
    sys.path.insert(0, str(place.parent))
    try:
        spec = importlib.util.spec_from_file_location("real_pendulum", place)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(place.parent))
    return module.compare(DATA)


def test_the_run_held_out_is_predicted(compared):
    assert compared["verdict"]["word"] == "USABLE"
    assert compared["errors"]["ddp"]["madoc"] < 0.06


def test_no_published_parameters_predict_runs_better(compared):
    for run, errors in compared["errors"].items():
        assert errors["madoc"] <= min(errors.values()), run


def test_the_length_is_that_of_the_rod(compared):
    low, high = compared["parameters"]["length"]["interval"]
    assert low < 0.5 < high
