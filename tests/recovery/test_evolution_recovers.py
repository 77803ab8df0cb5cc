"""The calibrators that search by CMA-ES, and OTED's bandit, find the truth of robots small enough for seconds."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import simulation
from madoc.calibration import CalibrationProblem, CmaEs, Droid, Dropo, Oted, calibrate
from madoc.data import Disturbance, disturb, observed_task
from robots import ARM_TRUTH, SPRING_TRUTH, recorded, spring, two_link_arm

ROBOTS = {"spring": (spring(max_episode_steps=100), SPRING_TRUTH), "arm": (two_link_arm(), ARM_TRUTH)}
DAMPINGS = ["dof_damping.shoulder", "dof_damping.elbow"]
IN_PART = {
    "spring in part": (
        spring(max_episode_steps=100).with_parameters(["jnt_stiffness.slide"]),
        {"jnt_stiffness.slide": 6.5},
    ),
    "arm in part": (two_link_arm().with_parameters(DAMPINGS), {name: ARM_TRUTH[name] for name in DAMPINGS}),
}
"""What distributions alone can tell: of a linear spring not three parameters, of an arm not masses and gravity."""
NEAR = 0.1
"""% of its range that droid and cma-es on one-step errors may be off on clean data, ..."""
LIKELY = 5.0
"""... dropo, which draws whole distributions and settles last where they hardly matter, ..."""
MATCHED = 10.0
"""... distributions of rows whose pairing is lost, ..."""
ACTED = 25.0
"""... and those of a clone's own rollouts, the roughest of all."""
TOLD = 15.0
"""... of windows of positions alone: mid-range is 19 to 25 off."""
CLONED = {"hidden": (32, 32), "cloning_epochs": 5, "sensor_noise": 0.0}


def off(method, robot, *, rows=2000, budget=100_000, **disturbance):
    """How far each parameter is from the truth, in % of its range, and the result."""
    task, truth = (ROBOTS | IN_PART)[robot]
    log = recorded(task, truth, rows, jax.random.key(100))
    task = replace(task, velocities=task.observation_size // 2)
    log = disturb(log, Disturbance(**disturbance), task, jax.random.key(101))
    problem = CalibrationProblem(log, simulation.make(observed_task(task, log), threads=1))
    result = calibrate(method, problem, key=jax.random.key(0), budget=budget)
    space = task.parameters
    return 100.0 * np.abs(result.mean - space.vector(truth)) / (space.high - space.low), result


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("method", [Droid(), CmaEs()])
def test_errors_of_replayed_rows_lead_to_the_truth_and_the_search_ends_there(robot, method):
    error, result = off(method, robot)
    assert (error < NEAR).all(), error
    assert result.status == "converged", result.sentence
    assert not result.warnings


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("weight", [pytest.param(0.0, marks=pytest.mark.slow), 0.1])
def test_a_likely_distribution_stands_about_the_truth(robot, weight):
    error, _ = off(Dropo(sensor_noise=0.0, entropy_weight=weight), robot)
    assert (error < LIKELY).all(), error


@pytest.mark.slow
def test_an_entropy_bonus_keeps_the_distribution_wide():
    narrow, wide = (off(Dropo(sensor_noise=0.0, entropy_weight=weight), "spring")[1].std for weight in (0.0, 3.0))
    assert (wide > narrow).all()


@pytest.mark.parametrize("robot", IN_PART)
def test_distributions_suffice_where_pairs_are_lost(robot):
    error, _ = off(CmaEs("distribution"), robot, rows=5000, budget=60_000, shuffled="next_observations")
    assert (error < MATCHED).all(), error


@pytest.mark.slow
def test_a_clone_that_acts_says_less_but_needs_no_states():
    method = CmaEs("distribution", "policy", **CLONED)
    error, _ = off(method, "arm in part", rows=5000)
    assert (error < ACTED).all(), error


@pytest.mark.slow
@pytest.mark.parametrize("method", [CmaEs("distribution", **CLONED), Oted(**CLONED)])
def test_windows_of_a_clones_positions_tell_where_velocities_are_hidden(method):
    error, result = off(method, "spring", rows=5000, hidden_velocities=True)
    assert (error < TOLD).all(), error
    assert any("hides velocities" in warning for warning in result.warnings)
