"""Madoc finds the truth of robots small enough for seconds, and knows when it cannot."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import simulation
from madoc.calibration import CALIBRATORS, CalibrationProblem, calibrate
from madoc.parameters import Parameter
from robots import ARM_TRUTH, SPRING_TRUTH, recorded, spring, two_link_arm

TOLERANCE = 5.0
"""% of its range that each parameter may be off."""
SLOW = ("madoc-s", "madoc-vdn")


def quick(name, **changes):
    """A variant with nets for a spring: smaller, so they may learn faster than those for a robot."""
    method = CALIBRATORS[name].make()
    sizes = {"hidden": (48, 48), "critic_hidden": (24, 24), "batch": 128}
    agents = replace(method.agents, **sizes, actor_rate=1e-2, blur_rate=1e-2, average_rate=3e-3)
    less = {"hidden": (32, 32), "cloning_epochs": 2, "grouping_epochs": 2, "epoch_steps": 300, "updates": 60}
    less |= {"regression_hidden": (64, 64), "regression_epochs": 10}
    return replace(method, **(less | {"agents": agents} | changes))


def problem_of(task, truth):
    return CalibrationProblem(recorded(task, truth, 5000, jax.random.key(100)), simulation.make(task, threads=1))


def off(result, task, truth):
    """How far each parameter is from the truth, in % of its range."""
    space = task.parameters
    return 100.0 * np.abs(result.mean - space.vector(truth)) / (space.high - space.low)


@pytest.mark.parametrize("name", ["madoc", *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_a_spring_is_recovered(name):
    task = spring(max_episode_steps=100)
    result = calibrate(quick(name), problem_of(task, SPRING_TRUTH), key=jax.random.key(0), budget=45_000)
    assert (off(result, task, SPRING_TRUTH) < TOLERANCE).all(), off(result, task, SPRING_TRUTH)
    assert not result.warnings


@pytest.mark.slow
def test_a_two_link_arm_is_recovered():
    task = two_link_arm()
    method = quick("madoc", patience=0)
    result = calibrate(method, problem_of(task, ARM_TRUTH), key=jax.random.key(0), budget=120_000)
    assert (off(result, task, ARM_TRUTH) < TOLERANCE).all(), off(result, task, ARM_TRUTH)


def stiffness(low, high):
    """A spring of which all but the stiffness is known: 4 N/m of it."""
    return spring(Parameter("jnt_stiffness", "slide", low, high), max_episode_steps=100)


@pytest.mark.slow
def test_it_stops_by_itself_once_nothing_is_left_to_learn():
    task, truth = stiffness(1.0, 9.0), {"jnt_stiffness.slide": 4.0}
    method = quick("madoc-s", patience=40)
    result = calibrate(method, problem_of(task, truth), key=jax.random.key(0), budget=300_000)
    assert result.status == "converged", result.sentence
    assert result.control_steps < 300_000
    assert (off(result, task, truth) < TOLERANCE).all(), off(result, task, truth)


@pytest.mark.slow
def test_a_truth_outside_the_range_is_found_at_its_end_and_told():
    target = stiffness(1.0, 9.0)
    log = recorded(target, {"jnt_stiffness.slide": 8.0}, 5000, jax.random.key(100))
    problem = CalibrationProblem(log, simulation.make(stiffness(1.0, 5.0), threads=1))
    method = quick("madoc-s", patience=0)
    result = calibrate(method, problem, key=jax.random.key(0), budget=60_000)
    assert result.mean == pytest.approx(5.0, abs=0.1)
    assert any("at the end of its range: jnt_stiffness.slide" in warning for warning in result.warnings)


@pytest.mark.slow
def test_rows_at_the_mean_are_compared_with_mid_range_where_discriminators_see_raw_states_too():
    raw = quick("madoc", features="raw", patience=0, cloning_epochs=1, updates=2)
    method = replace(raw, agents=replace(raw.agents, reward_size=0.0))
    problem = problem_of(spring(), SPRING_TRUTH)
    state = method.init(problem, jax.random.key(0))
    for _ in range(4):
        state, _ = method.step(problem, state)
    assert state.watch.gain != 0.0
    assert state.watch.gain_squared > 0.0
