"""Planted situations end in the verdict that is true of them."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from planted_logs import FEWER, ROBOTS, at_rest, bench, log_of, shuffled, verdict

from calibrating import madoc
from madoc.calibration import CmaEs, Droid, LeastSquares
from madoc.data import Disturbance, disturb, hide_velocities, observed_task
from madoc.errors import MadocError
from madoc.verdict import judge
from madoc.verdict.assessment import measured

EVERY = pytest.mark.parametrize("robot", ["spring", pytest.param("arm", marks=pytest.mark.slow)])
NOISES = pytest.mark.parametrize("noise", [0.0, 0.1, pytest.param(0.3, marks=pytest.mark.slow)])


@EVERY
@NOISES
def test_a_model_that_can_is_calibrated_and_its_noise_is_told(robot, noise):
    task, _ = ROBOTS[robot]
    log = log_of(robot, rows=2000, noise=noise)
    said, found = verdict(log, task)
    assert said.word == "CALIBRATED", said.sentence
    change = (log.transitions.next_observation - log.transitions.observation).std(0)
    assert np.array(list(found.noise.values())) / change == pytest.approx(noise, rel=0.2, abs=1e-6)
    for left, alone in zip(found.errors.estimate, found.errors.noise, strict=True):
        assert left.mean == pytest.approx(alone.mean, rel=0.25, abs=1e-6)


def test_an_open_parameter_at_an_end_of_its_range_says_nothing_of_what_lies_beyond():
    task, truth = ROBOTS["spring"]
    judged, mean = bench(log_of("spring"), task), task.parameters.vector(truth)
    mean[2] = task.parameters.high[2]
    ends = np.stack([task.parameters.low, task.parameters.high], axis=-1)
    narrow = np.stack([mean - 0.01, np.minimum(mean + 0.01, task.parameters.high)], axis=-1)
    assert measured(judged, mean, narrow).at_end == ("body_mass.cart",)
    assert measured(judged, mean, ends).at_end == ()


@EVERY
@pytest.mark.parametrize(
    "noise", [0.0, pytest.param(0.1, marks=pytest.mark.slow), pytest.param(0.3, marks=pytest.mark.slow)]
)
def test_a_wrong_fixed_parameter_is_a_mismatch(robot, noise):
    task, _ = ROBOTS[robot]
    said, _ = verdict(log_of(robot, rows=2000, noise=noise), task.with_parameters(FEWER[robot]))
    assert said.word in {"MODEL_MISMATCH", "USABLE"}, said.sentence


@pytest.mark.parametrize("noise", [0.0, pytest.param(0.05, marks=pytest.mark.slow)])
def test_without_forces_only_ratios_are_told(noise):
    task, _ = ROBOTS["spring"]
    log = disturb(at_rest("spring"), Disturbance(noise=noise), task, jax.random.key(0))
    said, _ = verdict(log, task)
    assert said.word == "NOT_IDENTIFIABLE"
    assert {"jnt_stiffness.slide", "body_mass.cart"} <= set(said.parameters)


def test_mid_range_and_an_estimate_that_is_no_better_are_no_improvement():
    task, truth = ROBOTS["spring"]
    judged = bench(log_of("spring"), task)
    for mean in (task.parameters.middle, task.parameters.to_physical([-0.9, 0.9, 0.9])):
        said = judge(measured(judged, mean))
        assert said.word == "NO_IMPROVEMENT", said.sentence
    assert judge(measured(judged, task.parameters.vector(truth))).word == "CALIBRATED"


@EVERY
@pytest.mark.parametrize("noise", [pytest.param(0.0, marks=pytest.mark.slow), 0.1])
def test_a_search_that_stopped_early_is_no_mismatch_where_velocities_are_hidden(robot, noise):
    task, truth = ROBOTS[robot]
    task = replace(task, velocities={"spring": 1, "arm": 2}[robot])
    log = disturb(log_of(robot, noise=noise), Disturbance(hidden_velocities=True), task, jax.random.key(0))
    judged, true = bench(log, hide_velocities(task)), task.parameters.vector(truth)
    half = measured(judged, 0.5 * (true + task.parameters.middle))
    said = judge(half)
    assert said.word == "NO_IMPROVEMENT", said.sentence
    assert "the search is not at its end" in said.sentence
    assert half.errors.nearby_relative < 0.6 * half.errors.relative
    assert judge(measured(judged, true)).word == "CALIBRATED"


def test_velocities_that_are_differences_of_noisy_positions_are_not_taken_for_states():
    task, truth = ROBOTS["arm"]
    task = replace(task, velocities=2)
    wanted = Disturbance(hidden_velocities=True, velocities="differences")
    log = disturb(log_of("arm", noise=0.1), wanted, task, jax.random.key(0))
    said = judge(measured(bench(log, observed_task(task, log)), task.parameters.vector(truth)))
    assert said.word == "CALIBRATED", said.sentence


@pytest.mark.parametrize(
    ("robot", "how"),
    [
        *(("spring", "next"), ("arm", "rows")),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in (("spring", "rows"), ("arm", "next"))),
    ],
)
def test_shuffled_next_observations_are_rejected_whatever_the_estimate(robot, how):
    task, truth = ROBOTS[robot]
    judged = bench(shuffled(log_of(robot), how), task)
    assert judge(measured(judged, task.parameters.vector(truth))).word == "DATA_REJECTED"


METHODS = {
    "least-squares": LeastSquares(),
    "least-squares of windows": LeastSquares(horizon=5),
    "droid": Droid(),
    "cma-es": CmaEs(),
    "cma-es-distribution": CmaEs("distribution"),
    "madoc": madoc(),
}


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("how", ["next", "rows", "episode", "labelled"])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("seed", range(3))
def test_shuffled_next_observations_are_never_calibrated(robot, how, method, seed):
    task, _ = ROBOTS[robot]
    log = log_of(robot, noise=0.1 * (seed % 2), seed=seed)
    if how == "labelled":
        log = disturb(log, Disturbance(shuffled="next_observations"), task, jax.random.key(seed))
    else:
        log = shuffled(log, how, seed)
    try:
        said, _ = verdict(log, task, METHODS[method], budget=20_000, seed=seed)
    except MadocError as refusal:
        assert how == "labelled", refusal
        return
    # Within short episodes next observations stay near: a mismatch is as true.
    assert said.word in {"DATA_REJECTED", *(["MODEL_MISMATCH", "NOT_IDENTIFIABLE"] if how == "episode" else [])}, said


def test_whole_rows_in_a_random_order_are_as_good():
    task, _ = ROBOTS["spring"]
    log = disturb(log_of("spring"), Disturbance(shuffled="rows"), task, jax.random.key(0))
    said, found = verdict(log, task)
    assert said.word == "CALIBRATED", said.sentence
    assert [error.steps for error in found.errors.estimate] == [1]


def test_the_same_estimate_gives_the_same_bits():
    task, _ = ROBOTS["spring"]
    log = log_of("spring", rows=300, noise=0.1)
    first, again = (measured(bench(log, task), task.parameters.middle) for _ in range(2))
    assert first == again
