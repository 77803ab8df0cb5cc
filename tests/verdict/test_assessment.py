"""`madoc.assess`: a verdict right after a calibration, and for a result read from a file."""

import json
import time
from dataclasses import replace

import jax
import numpy as np
import pytest
from planted_logs import ROBOTS, log_of

import madoc
from madoc import robots, simulation
from madoc.calibration import CalibrationProblem, CalibrationResult, LeastSquares
from madoc.calibration.least_squares import timestep
from madoc.data.dataset import hold_out
from madoc.errors import MadocError
from madoc.identification.causes import INTEGRATION
from madoc.identification.term_tests import Alternative, Suspicions
from madoc.verdict import Bench
from own_robots import SPRING_SPEC, write_robot
from robots import SPRING_TRUTH, recorded

TASK, _ = ROBOTS["spring"]


@pytest.fixture(scope="module")
def split():
    return hold_out(log_of("spring", rows=500, noise=0.05), 0.2, jax.random.key(0))


@pytest.fixture(scope="module")
def result(split):
    problem = CalibrationProblem(split.kept, simulation.make(TASK, threads=1))
    return madoc.calibrate(LeastSquares(), problem, key=jax.random.key(0), budget=100_000)


def test_a_result_and_rows_held_out_are_all_it_needs(result, split):
    found = madoc.assess(result, split.held)
    assert found.verdict.word == "CALIBRATED"
    assert str(found).startswith("CALIBRATED: over ")
    assert (found.holdout.rows, found.holdout.measure) == (len(split.held), "predicted")
    assert found.holdout.split == "100 rows in 1 episode were held out"


def test_what_a_search_that_had_not_settled_predicts_comes_before_tests(result, split):
    problem, told = CalibrationProblem(split.kept, simulation.make(TASK, threads=1)), []
    bench = Bench(problem, split.held, jax.random.key(0), tell=told.append)
    orders = []
    for settled in (True, False):
        told.clear()
        found = madoc.assess(replace(result, settled=settled), bench)
        orders.append([told.index("predictions over longer times"), told.index("tests of what the model lacks")])
        assert found.result.judging_seconds > 0.0
    assert orders[0][0] > orders[0][1] and orders[1][0] < orders[1][1]
    assert found.holdout.open_loop and found.verdict.word == "USABLE"
    hurried = madoc.assess(replace(result, settled=False), replace(bench, until=time.monotonic()))
    assert "nor was tested whether the model lacks anything" in hurried.verdict.sentence


def test_without_time_nothing_is_said_to_be_tested(result, split):
    bench = Bench(CalibrationProblem(split.kept, simulation.make(TASK, threads=1)), split.held, jax.random.key(0))
    found = madoc.assess(result, replace(bench, until=time.monotonic()))
    assert found.verdict.word == "NOT_IDENTIFIABLE" and not found.holdout.tested
    assert "was not tested, as the budget left no time for that" in found.verdict.sentence
    assert found.holdout.open_loop == ()
    assert found.result.warnings[-1] == (
        "the budget left no time for these parts of judging: whether columns are exchanged; tests of what the model "
        "lacks; predictions over longer times (give it a larger one with --budget)"
    )
    in_full = madoc.assess(result, replace(bench, until=time.monotonic() + 1000.0, rate=1e5))
    assert max(in_full.holdout.open_loop[0].beside_noise.values()) < 1.3
    assert in_full.verdict.word == "CALIBRATED" and in_full.holdout == madoc.assess(result, bench).holdout


def test_what_only_tests_on_few_windows_leave_open_asks_for_time(result, split, monkeypatch):
    name = next(iter(result.parameters))
    wide = Suspicions(alternatives=(Alternative(("friction",), {name: 0.0}, {name: 1e6}),))
    monkeypatch.setattr("madoc.verdict.records.suspicions", lambda *_, **__: wide)
    bench = Bench(CalibrationProblem(split.kept, simulation.make(TASK, threads=1)), split.held, jax.random.key(0))
    assert (found := madoc.assess(result, bench)).holdout.open_in_time == ()
    assert (found.verdict.word, found.verdict.parameters) == ("NOT_IDENTIFIABLE", (name,))
    rate = 1.01 * bench.windows_to_test * replace(bench, rate=1.0).window_seconds / 1000.0
    few = madoc.assess(result, replace(bench, until=time.monotonic() + 1000.0, rate=rate))
    assert few.holdout.open_in_time == few.verdict.parameters == (name,)
    assert f"leaves {name} open; give it a larger budget" in few.verdict.sentence


@pytest.mark.parametrize("tried", [False, True])
def test_a_log_of_a_finer_simulation_is_judged_with_its_timestep_or_beside_the_error(tmp_path, monkeypatch, tried):
    if not tried:
        monkeypatch.setattr(timestep, "_worth_trying", lambda *_: False)
    task = robots.load(write_robot(tmp_path, SPRING_SPEC)).task
    log = recorded(task.with_time_step(0.25, substeps=4), SPRING_TRUTH, 500, jax.random.key(0))
    parts = hold_out(log, 0.2, jax.random.key(0))
    problem = CalibrationProblem(parts.kept, simulation.make(task, threads=1))
    estimate = madoc.calibrate(LeastSquares(), problem, key=jax.random.key(0), budget=100_000)
    found = madoc.assess(estimate, parts.held)
    assert found.verdict.word == "CALIBRATED"
    errors = [term for term in found.holdout.missing_terms if term.cause == INTEGRATION]
    space = problem.simulator.parameters
    truth = space.vector(SPRING_TRUTH)
    assert estimate.timesteps == (4 if tried else 1)
    if tried:
        assert not errors
        np.testing.assert_allclose(estimate.mean, truth, rtol=1e-6)
    else:
        assert errors[0].value == pytest.approx(1.0, abs=0.01) and errors[0].explained > 0.99
        shorter = madoc.assess(replace(estimate, test_timesteps=4), parts.held)  # as a filter's, of its own timestep
        assert shorter.holdout.noise == found.holdout.noise and shorter.holdout.open_loop == found.holdout.open_loop
        terms = {term.cause: term for term in shorter.holdout.missing_terms}
        assert shorter.holdout.timestep_of_tests == "shorter" and found.holdout.timestep_of_tests == "same"
        assert shorter.verdict.word == "CALIBRATED"
        assert INTEGRATION not in terms and not any(term.explained > 0.01 for term in terms.values())
        late = Bench(problem, parts.held, jax.random.key(0), until=time.monotonic() + 60.0, rate=1e9, divided=4)
        for bench in (late, late.with_timestep_of(4)):
            shorter, beside = bench.for_tests()
            assert shorter.problem is problem.with_shorter_timestep
            assert beside == ("same" if bench.own else "shorter") and not bench.left_out
            own, beside = replace(bench, rate=1.0).for_tests()  # with no time for it
            assert own.problem is problem and beside == ("longer" if bench.own else "same")
            assert bench.left_out.pop() == "tests with the shorter timestep"
    low, high = np.asarray(found.result.interval).T
    assert (np.maximum(low - truth, truth - high) < 1e-4 * (space.high - space.low)).all()


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
