"""`madoc.assess`: a verdict right after a calibration, and for a result read from a file."""

import json

import jax
import pytest
from planted import ROBOTS, log_of

import madoc
from madoc import simulation
from madoc.calibration import CalibrationProblem, CalibrationResult, LeastSquares
from madoc.data.split import hold_out
from madoc.errors import MadocError

TASK, _ = ROBOTS["spring"]


@pytest.fixture(scope="module")
def split():
    return hold_out(log_of("spring", rows=500, noise=0.05), 0.2, jax.random.key(0))


@pytest.fixture(scope="module")
def result(split):
    problem = CalibrationProblem(split.kept, simulation.make(TASK, threads=1))
    return madoc.calibrate(LeastSquares(), problem, key=jax.random.key(0), budget=30_000)


def test_a_result_and_rows_held_out_are_all_it_needs(result, split):
    found = madoc.assess(result, split.held)
    assert found.verdict.word == "CALIBRATED"
    assert str(found).startswith("CALIBRATED: the prediction error on the hold-out is")
    assert (found.holdout.rows, found.holdout.measure) == (len(split.held), "predicted")
    assert found.holdout.split == "100 rows in 1 episode were held out"


def test_a_result_from_a_file_needs_to_be_told_what_was_calibrated(result, split):
    stored = CalibrationResult.from_json(json.loads(json.dumps(result.to_json())))
    assert stored == result and stored.problem is None
    with pytest.raises(MadocError, match=r"give training=.* and simulator="):
        madoc.assess(stored, split.held)
    again = madoc.assess(stored, split.held, training=split.kept, simulator=result.problem.simulator)
    assert again == madoc.assess(result, split.held)


def test_what_cannot_be_judged_is_refused(result, split):
    with pytest.raises(MadocError, match="expected at least 10 rows held out to judge a result by, got 5 beside 400"):
        madoc.assess(result, hold_out(split.held, 0.05, jax.random.key(0)).held)
    fewer = simulation.make(TASK.with_parameters(["body_mass.cart"]), threads=1)
    with pytest.raises(MadocError, match="expected a simulator with the result's parameters"):
        madoc.assess(result, split.held, simulator=fewer)
