"""Initial states fitted to the first steps of held-out windows whose velocities are hidden."""

from dataclasses import replace

import jax
import numpy as np
from planted_logs import ROBOTS, bench, log_of

from madoc import simulation
from madoc.data import Disturbance, disturb, hide_velocities
from madoc.identification import fitted_windows
from madoc.identification.linearisation import WindowSlopes
from madoc.verdict.bench import FEWEST_FITTED
from madoc.verdict.fitted_starts import fitted_replays_of, replay_steps
from robots import counted

ARM, TRUTH = replace(ROBOTS["arm"][0], velocities=2), ROBOTS["arm"][1]
AT_TRUTH = ARM.parameters.to_unit(ARM.parameters.vector(TRUTH))[None]


def replays_under(noise):
    log = disturb(log_of("arm", rows=600, noise=noise), Disturbance(hidden_velocities=True), ARM, jax.random.key(0))
    simulator = simulation.make(hide_velocities(ARM), threads=1)
    return fitted_replays_of(log, simulator, np.full(2, 0.1), 1)


def test_hidden_velocities_are_found_at_the_truth():
    residuals = replays_under(0.0).residuals(AT_TRUTH)
    assert np.abs(residuals).max() < 1e-8


def test_fits_end_where_steps_gain_little():
    replays = replays_under(0.2)
    _, spent = counted(replays.starts, AT_TRUTH)
    of_a_step = (1 + 4 + 3) * replays.fitted * len(replays.readings)  # residuals, differences, shares of the step
    assert spent % (of_a_step // len(replays.readings)) == 0
    assert of_a_step < spent < 2.5 * of_a_step  # the second step moves the windows that the first one gained on
    assert counted(replace(replays, most_steps=1).starts, AT_TRUTH)[1] == of_a_step
    residuals, whole = counted(replays.residuals, AT_TRUTH)
    assert whole == spent + len(replays.readings) * replays.readings.steps
    first, ahead = residuals[0, :, : replays.fitted + 1], residuals[0, :, replays.fitted + 1 :]
    assert (
        0.3 < first.std() / ahead.std() < 1.0
    )  # noise alone is left of the one, errors of the state grow in the other


def test_starts_near_those_of_another_system_are_as_good_and_no_better():
    replays, point = replays_under(0.2), AT_TRUTH + 0.01
    states = replays.starts(AT_TRUTH)
    (alone, spent), (near, fewer) = counted(replays.starts, point), counted(replays.starts, point, states[0])
    left = [np.square(replays.residuals_from(point, each)[0, :, : replays.fitted + 1]).sum() for each in (alone, near)]
    np.testing.assert_allclose(left[1], left[0], rtol=1e-3)
    assert fewer < spent
    hurried = replace(replays, most_steps=1)  # more steps would be an advantage over the other system
    np.testing.assert_array_equal(hurried.starts(point, states[0]), hurried.starts(point))


def test_the_best_nearby_is_the_estimate_where_every_simulation_fails(monkeypatch):
    replays = replays_under(0.2)
    windows = len(replays.readings)
    values = replays.readings.observed[0].size
    parts = np.zeros((windows, values)), np.zeros((windows, values, 4)), np.zeros((windows, values, 4))
    failed = WindowSlopes(*parts, whole=np.zeros(windows, dtype=bool))
    monkeypatch.setattr(fitted_windows, "slopes_at", lambda *_, **__: [failed])
    nearby = fitted_windows.fit_windows(replays.simulator, replays.readings, replays.near, AT_TRUTH[0])
    np.testing.assert_array_equal(nearby.point, AT_TRUTH[0])


def test_starts_take_fewer_steps_where_time_is_short(monkeypatch):
    judged = replace(bench(log_of("arm", rows=400), ROBOTS["arm"][0]), until=100.0, rate=50.0)
    monkeypatch.setattr("madoc.verdict.bench.time.monotonic", lambda: 90.0)
    assert [judged.steps_in_time(each, 1.0) for each in (500, 1000, 10**6)] == [10, 5, 2]
    assert [judged.steps_in_time(each, 0.5) for each in (250, 500, 10**6)] == [10, 5, 2]
    assert replace(judged, until=None).steps_in_time(10**6, 0.5) == 10


def test_the_hold_out_leaves_time_for_tests_of_the_model(monkeypatch):
    judged = replace(bench(log_of("arm", rows=400), ROBOTS["arm"][0]), until=100.0)
    monkeypatch.setattr("madoc.verdict.bench.time.monotonic", lambda: 90.0)
    to_test = judged.windows_to_test * replace(judged, rate=1.0).window_seconds  # control steps
    columns = replay_steps(judged.states, 1, len(ARM.parameters))
    # Of the time left for tests, and then for the hold-out; where tests leave less than a tenth they are left out.
    shares = ((0.3, 0.4), (0.65, 0.35), (0.89, 0.11), (0.95, 0.4), (1.5, 0.4))
    for share, of_hold_out in shares:
        timed = replace(judged, rate=to_test / share / 10.0)
        affordable = int(of_hold_out * timed.rate * 10.0 / columns)
        assert len(timed.fitted.rows) == min(len(judged.fittable.rows), max(FEWEST_FITTED, affordable))
