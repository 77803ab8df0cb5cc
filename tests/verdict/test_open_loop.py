"""Open-loop predictions beside the user's own model, on planted logs."""

from dataclasses import replace
from itertools import pairwise

import jax
import numpy as np
import pytest
from planted_logs import ROBOTS, log_of

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem
from madoc.data import Disturbance, disturb, observed_task
from madoc.identification.states import logged_states
from madoc.identification.windows import evenly, rows_that_fit
from madoc.simulation.write import nominal_values
from madoc.verdict import Bench
from madoc.verdict import open_loop as module
from madoc.verdict.judge import BEYOND_RANDOM
from madoc.verdict.open_loop import MOST, as_given, beyond_imitated, open_loop
from madoc.verdict.statistics import ABOVE_NOISE
from own_robots import SPRING_SPEC, write_robot
from robots import SPRING_TRUTH, recorded

TASK, TRUTH = ROBOTS["spring"]
TASK = replace(TASK, velocities=1)


def bench_of(disturbance=None):
    log = log_of("spring", rows=600)
    if disturbance is not None:
        log = disturb(log, disturbance, TASK, jax.random.key(0))
    train, held = log.split(0.3)
    simulator = simulation.make(observed_task(TASK, log), threads=1)
    return Bench(CalibrationProblem(train, simulator), held, jax.random.key(0))


def at_truth(bench):
    space = bench.simulator.parameters
    return space.to_unit(space.vector(TRUTH))


def test_the_model_as_given_has_the_values_of_its_file_and_no_range_bounds_them():
    simulator = as_given(simulation.make(TASK, threads=1))
    own = [value for row in TASK.parameters.parameters for value in nominal_values(TASK.model, row)]
    assert simulator.parameters.to_physical(-np.ones(len(own))) == pytest.approx(own)


@pytest.mark.parametrize("disturbance", [None, Disturbance(hidden_velocities=True)])
def test_the_truth_predicts_and_the_model_as_given_does_not(disturbance):
    bench = bench_of(disturbance)
    predictions = open_loop(bench, at_truth(bench))
    assert [each.whole for each in predictions][-1]
    assert all(first.seconds < second.seconds for first, second in pairwise(predictions))
    for each in predictions:
        assert each.relative < 0.01 and each.relative_interval[1] < 0.02
        assert all(each.estimate[name] < 0.01 * each.as_given[name] for name in each.estimate)


def test_errors_are_those_of_stepping_on_from_the_log_in_the_signals_own_units():
    bench = bench_of()
    held, simulator = bench.held_out, bench.simulator
    first = open_loop(bench, at_truth(bench))[0]
    steps = round(first.seconds / simulator.control_step)
    states, rows = logged_states(held, simulator.task)
    begins = evenly(rows_that_fit(held, rows, steps), MOST)
    system, state, errors = simulator.bind(simulator.parameters.middle[None]), states[begins][None], []
    for step in range(steps):
        state = system.step(state, np.asarray(held.transitions.action)[rows[begins] + step][None])
        errors.append(system.observe(state)[0] - held.transitions.next_observation[rows[begins] + step])
    assert list(first.mid_range.values()) == pytest.approx(np.sqrt((np.square(errors)).mean((0, 1))))


def test_noise_of_the_states_where_predictions_begin_counts_for_nothing_once_they_are_fitted():
    bench = bench_of(Disturbance(noise=0.3))
    logged, fitted = (open_loop(bench, at_truth(bench), fits_starts=fits)[-2] for fits in (False, True))
    assert fitted.seconds == logged.seconds
    assert all(fitted.estimate[name] < 0.9 * logged.estimate[name] for name in fitted.estimate)
    assert fitted.estimate["observation[0]"] < 1.2 * bench.problem.noise_by_differences[0]


def test_fitted_predictions_are_as_good_as_those_of_an_imitated_hold_out_where_the_model_is_right():
    bench = bench_of(Disturbance(noise=0.3))
    point, covariance = at_truth(bench), 1e-6 * np.eye(len(TASK.parameters))
    right = open_loop(bench, point, fits_starts=True, covariance=covariance)
    assert all(set(each.beside_noise) == set(each.estimate) for each in right)
    assert max(max(each.beside_noise.values()) for each in right) < 1.3
    # An estimate 5 % of a range off is 20 times as far off as it is said to be, and as far as it is said to be.
    wrong = open_loop(bench, point + 0.1, fits_starts=True, covariance=25.0 * covariance)
    assert max(wrong[-1].beside_noise.values()) > ABOVE_NOISE and wrong[-1].whole
    assert max(wrong[-2].beside_noise.values()) > BEYOND_RANDOM
    unsure = open_loop(bench, point + 0.1, fits_starts=True, covariance=1e-2 * np.eye(len(point)))
    assert max(unsure[-1].beside_noise.values()) < ABOVE_NOISE
    assert max(max(each.beside_noise.values()) for each in unsure[:-1]) < BEYOND_RANDOM
    assert not open_loop(bench, point, covariance=covariance)[0].beside_noise  # from logged states, of unknown noise


def test_random_forces_that_were_found_act_on_an_imitated_hold_out_too():
    train, held = recorded(TASK, TRUTH, 900, jax.random.key(0), force=0.5).split(0.4)
    bench = Bench(CalibrationProblem(train, simulation.make(TASK, threads=1)), held, jax.random.key(0))
    point, covariance = at_truth(bench), 1e-6 * np.eye(len(TASK.parameters))
    known, unknown = (
        open_loop(bench, point, fits_starts=True, covariance=covariance, forces=forces)
        for forces in (np.array([0.5]), np.zeros(0))
    )
    assert max(max(each.beside_noise.values()) for each in known) < 1.1
    assert max(max(each.beside_noise.values()) for each in unknown) > BEYOND_RANDOM


def test_logged_predictions_are_compared_with_those_of_chance_up_to_a_second():
    bench = bench_of(Disturbance(noise=0.1))
    point, covariance = at_truth(bench), 1e-6 * np.eye(len(TASK.parameters))
    noise = np.full(2, 0.1)
    right = open_loop(bench, point, covariance=covariance, noise=noise)
    assert all(set(each.beside_noise) == set(each.estimate) for each in right[:-1]) and not right[-1].beside_noise
    assert 0.7 < max(max(each.beside_noise.values()) for each in right[:-1]) < 1.1
    wrong = open_loop(bench, point + 0.3, covariance=covariance, noise=noise)
    assert max(wrong[-2].beside_noise.values()) > BEYOND_RANDOM
    honest = point + 0.1 * np.random.default_rng(3).standard_normal((8, len(point)))
    unsure = [open_loop(bench, each, covariance=1e-2 * np.eye(len(point)), noise=noise)[-2] for each in honest]
    assert sum(max(each.beside_noise.values()) > BEYOND_RANDOM for each in unsure) == 0


@pytest.mark.parametrize("fits_starts", [False, True])
def test_errors_that_the_timestep_makes_are_in_an_imitated_hold_out_too(tmp_path, monkeypatch, fits_starts):
    """The log is of a timestep of a quarter of the length: at the truth nothing else is wrong, without noise."""
    task = robots.load(write_robot(tmp_path, SPRING_SPEC)).task
    log = recorded(task.with_time_step(0.25, substeps=4), SPRING_TRUTH, 600, jax.random.key(0))
    kept, held = log.split(0.3)
    bench = Bench(CalibrationProblem(kept, simulation.make(task, threads=1)), held, jax.random.key(0))
    space = bench.simulator.parameters
    point = space.to_unit(space.vector(SPRING_TRUTH))
    told = {"covariance": 1e-16 * np.eye(len(point)), "noise": np.full(2, 1e-9), "fits_starts": fits_starts}
    found = open_loop(bench, point, **told)[1]
    assert found.seconds == 0.3 and not found.whole
    assert 0.5 < max(found.beside_noise.values()) < 1.1
    monkeypatch.setattr(module, "_finer", lambda bench: bench.simulator)
    without = max(open_loop(bench, point, **told)[1].beside_noise.values())
    # From logged starts a part of the errors passes for random forces, which are read off the same log.
    assert without > (BEYOND_RANDOM if fits_starts else 1.1 * max(found.beside_noise.values()))


def test_loose_rows_are_not_predicted_over_time():
    bench = bench_of(Disturbance(shuffled="rows"))
    assert open_loop(bench, at_truth(bench)) == ()


def test_a_simulation_that_fails_counts_as_the_worst_that_does_not(monkeypatch):
    bench = bench_of()
    residuals = np.full((3, 6, 4, 2), 0.1)
    residuals[0], residuals[2, :, 1:] = 40.0, np.nan  # the model as given drifts far, the estimate blows up
    monkeypatch.setattr(module, "_from_logged", lambda *_: (residuals, np.arange(6) * 50))
    first = open_loop(bench, at_truth(bench))[0]
    assert first.relative == pytest.approx(np.sqrt((3 * 40.0**2 + 0.1**2) / 4) / 40.0)


def test_signals_count_by_the_share_of_their_error_that_chance_does_not_make():
    given, estimate, imitated = [4.0, 1.0, 1.0, 0.0], [0.1, 1.0, 9.0, 0.0], [0.1, 1.0, 1.0, 0.0]
    shares = beyond_imitated(np.array([given, given, estimate, imitated]))
    np.testing.assert_allclose(shares, [0.975, 0.0, 8.0 / 9.0, 1.0])  # the last has no error that chance could make
    assert (beyond_imitated(np.array([given, given, estimate])) == 1.0).all()
    assert (beyond_imitated(np.ones((4, 3))) == 1.0).all()  # all is chance
