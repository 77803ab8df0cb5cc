"""Permuting parameters permutes the estimate: every calibrator finds the same with the parameters the other way."""

from dataclasses import replace

import jax
import pytest
from test_least_squares_recovers import QUICK_OTED
from test_madoc_recovers import quick

from madoc import simulation
from madoc.calibration import CALIBRATORS, CalibrationProblem, calibrate
from robots import ARM_TRUTH, SPRING_TRUTH, recorded, spring, two_link_arm

SPRING = spring(max_episode_steps=100)
DAMPINGS = ["dof_damping.shoulder", "dof_damping.elbow"]
UNMOVED = ("nominal", "uniform")
"""They estimate nothing: the middle of the box, in whatever order."""
QUICK = {"least-squares": 1e-6, "droid": 0.1, "cma-es": 0.1, "dropo": 5.0}
"""% of its range that each parameter may be off."""
MADOC = ("madoc", "madoc-s", "madoc-vdn", "madoc-isac", "madoc-grouped")
SLOW = {"e-dropo": 5.0, "oted": 20.0, "cma-es-distribution": 10.0, "npe": 10.0} | dict.fromkeys(MADOC, 15.0)
SAME_CODE = ("madoc-paper",)
"""Other constants of a method that is here, too slow for a spring."""
KEY = jax.random.key(0)


def backward(task):
    """The task with its parameters in the reverse order."""
    return task.with_parameters(list(reversed(task.parameters.names)))


def estimated(name, task, truth, *, budget):
    """What a method believes of each parameter, by name."""
    method = CALIBRATORS[name].make()
    if name == "oted":
        method = QUICK_OTED
    elif name == "npe":
        method = replace(method, hidden=(64, 64), draws=20, epochs=4, cloning_epochs=10)
    elif name in MADOC:
        method = replace(quick(name), patience=0)
    elif name == "dropo":
        method = replace(method, sensor_noise=0.0)
    logged = recorded(task, {parameter: truth[parameter] for parameter in task.parameters.names}, 5000, KEY)
    result = calibrate(method, CalibrationProblem(logged, simulation.make(task, threads=1)), key=KEY, budget=budget)
    return {parameter: row.estimate for parameter, row in result.parameters.items()}


def test_no_calibrator_is_forgotten():
    assert set(CALIBRATORS) == {*QUICK, *SLOW, *UNMOVED, *SAME_CODE}


@pytest.mark.parametrize("name", UNMOVED)
def test_what_estimates_nothing_permutes_exactly(name):
    found = estimated(name, SPRING, SPRING_TRUTH, budget=1)
    assert estimated(name, backward(SPRING), SPRING_TRUTH, budget=1) == found


@pytest.mark.parametrize("name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_the_other_way_round(name):
    task, truth, budget = SPRING, SPRING_TRUTH, 100_000
    if name == "cma-es-distribution":  # distributions tell of a linear spring not three parameters
        task, truth, budget = two_link_arm().with_parameters(DAMPINGS), ARM_TRUTH, 60_000
    elif name == "oted":
        budget = 300_000
    elif name == "npe":
        budget = 60_000
    elif name in MADOC:
        budget = 36_000
    found = estimated(name, backward(task), truth, budget=budget)
    for parameter in task.parameters.parameters:
        off = 100.0 * abs(found[parameter.name] - truth[parameter.name]) / (parameter.high - parameter.low)
        assert off < (QUICK | SLOW)[name], (parameter.name, off)
