from dataclasses import replace

import jax
import numpy as np
import pytest
from planted_logs import ROBOTS, at_rest, log_of

from madoc import simulation
from madoc.calibration import CmaEs, LeastSquares
from madoc.data import Disturbance, disturb, hide_velocities, observed_task, stride
from madoc.errors import MadocError
from madoc.verdict.selftest import RECOVERABLE, STRETCH, plant, selftest

KEYS = [jax.random.key(0), jax.random.key(1)]


def run(log, task, *methods, noise=0.0, keys=KEYS):
    size = task.observation_size
    return selftest(
        methods or (LeastSquares(),),
        log,
        simulation.make(task, threads=1),
        noise=np.full(size, noise),
        signals=[f"signal {index}" for index in range(size)],
        keys=keys,
        budget=20_000,
    )


def test_a_planted_log_is_the_robots_own_motion_where_the_truth_is_planted():
    task, truth = ROBOTS["spring"]
    log = log_of("spring", rows=230)
    values = task.parameters.vector(truth)
    nothing = np.zeros(2)
    planted = plant(log, simulation.make(task, threads=1), values, noise=nothing, key=KEYS[0])
    assert len(planted) == len(log)
    assert np.array_equal(planted.transitions.action, log.transitions.action)
    assert planted.transitions.next_observation == pytest.approx(log.transitions.next_observation, abs=1e-12)
    assert np.diff(planted.episode_starts).max() == STRETCH * stride(log)
    ends = planted.transitions.terminated | planted.transitions.truncated
    assert (np.flatnonzero(ends) + 1).tolist() == planted.episode_ends.tolist()


def test_another_truth_moves_otherwise_and_noise_is_read_once():
    task, _ = ROBOTS["spring"]
    log, simulator = log_of("spring", rows=200), simulation.make(task, threads=1)
    clean, noisy = (
        plant(log, simulator, task.parameters.middle, noise=np.array(size), key=KEYS[0]).transitions
        for size in ([0.0, 0.0], [0.1, 0.2])
    )
    assert np.abs(clean.next_observation - log.transitions.next_observation).max() > 1e-3
    assert (noisy.observation - clean.observation).std(0) == pytest.approx([0.1, 0.2], rel=0.2)
    same = (noisy.next_observation[:-1] == noisy.observation[1:]).all(-1)
    assert same.sum() == 200 - 200 // (STRETCH * stride(log))


def test_hidden_velocities_start_at_resets():
    task, _ = ROBOTS["arm"]
    seen = replace(task, velocities=2)
    log = disturb(log_of("arm", rows=300), Disturbance(hidden_velocities=True), seen, KEYS[0])
    simulator = simulation.make(hide_velocities(seen), threads=1)
    planted = plant(log, simulator, task.parameters.middle, noise=np.zeros(2), key=KEYS[0])
    assert planted.episode_starts.tolist() == log.episode_starts.tolist()
    assert planted.transitions.observation.shape == (300, 2)


def test_where_velocities_are_differences_the_planted_ones_are_too():
    task, _ = ROBOTS["arm"]
    seen = replace(task, velocities=2)
    put_in = Disturbance(hidden_velocities=True, velocities="differences")
    log = disturb(log_of("arm", rows=300), put_in, seen, KEYS[0])
    simulator = simulation.make(observed_task(seen, log), threads=1)
    planted = plant(log, simulator, task.parameters.middle, noise=np.zeros(4), key=KEYS[0])
    assert planted.disturbance.velocities == "differences"
    angle, speed = np.split(planted.transitions.observation, 2, axis=1)
    inner = np.setdiff1d(np.arange(1, len(planted) - 1), [*planted.episode_starts, *(planted.episode_ends - 1)])
    between = (angle[inner + 1] - angle[inner - 1]) / (2 * simulator.control_step)
    assert speed[inner] == pytest.approx(between, abs=1e-9)


def test_data_that_can_find_a_truth_passes():
    task, _ = ROBOTS["spring"]
    outcome = run(log_of("spring"), task)
    assert outcome.passed
    assert outcome.method == "least-squares"
    assert "could find every parameter: each of 2 planted truths" in outcome.sentence
    assert outcome.sentence.endswith("of 6 95 % intervals hold the truth")
    assert len(outcome.rows) == 2 * 3
    assert all(row.percent_of_range < 1e-6 for row in outcome.rows)
    assert {row.truth for row in outcome.rows} == {1, 2}
    told = outcome.to_json()
    assert told["passed"] is True
    assert told["rows"][0]["interval"]


def test_data_without_forces_does_not():
    task, _ = ROBOTS["spring"]
    outcome = run(at_rest("spring"), task)
    assert not outcome.passed
    assert "body_mass.cart" not in outcome.recoverable
    worst = max(row.percent_of_range for row in outcome.rows if row.name == "body_mass.cart")
    assert worst > RECOVERABLE
    assert f"body_mass.cart ({worst:.0f} %)" in outcome.sentence


def test_the_first_method_that_does_not_refuse_is_run():
    task, _ = ROBOTS["spring"]
    log = log_of("spring", rows=100)
    refusing = LeastSquares(horizon=1000)
    assert run(log, task, refusing, LeastSquares(), keys=KEYS[:1]).method == "least-squares"
    assert run(log, task, refusing, CmaEs(), keys=KEYS[:1]).method == "cma-es"
    with pytest.raises(MadocError, match="no stretch of 1000 rows"):
        run(log, task, refusing)
