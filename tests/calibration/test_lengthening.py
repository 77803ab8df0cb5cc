"""Longer windows: where they begin, when they are taken, when they are not."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem, LeastSquares
from madoc.calibration.least_squares.calibrator import horizon_of
from madoc.calibration.least_squares.estimated_states import EstimatedStates
from madoc.calibration.least_squares.lengthening import begun, explain_as_well, lengthened
from madoc.checkpoint import difference, layout
from madoc.data import Disturbance, disturb
from own_robots import PENDULUM_SPEC, write_robot
from robots import PENDULUM, recorded

TRUTH = (1.2, 0.15, 1.6)


@pytest.fixture
def pendulum(tmp_path):
    return robots.load(write_robot(tmp_path, PENDULUM_SPEC)).task


def problem_of(task, *, rows=2000, noise=0.05):
    truth = dict(zip(task.parameters.names, TRUTH, strict=True))
    log = recorded(task, truth, rows, jax.random.key(0))
    if noise:
        log = replace(disturb(log, Disturbance(noise=noise), task, jax.random.key(1)), disturbance=Disturbance())
    return CalibrationProblem(log, simulation.make(task, threads=1))


def searches_of(problem):
    """A search on windows of five rows, with states that tell which window is which, and one on longer ones."""
    method = EstimatedStates(5, "cauchy", 40, 1, 4, 2, 1e-7)
    shorter = method.init(problem, jax.random.key(0))
    longer = lengthened(problem, shorter, 15, 3)
    return shorter, longer


def ended(method, problem):
    """The state in which it has nothing left to do."""
    state = method.init(problem, jax.random.key(0))
    while method.converged(state) is None and method.control_steps(state) < 2_000_000:
        state, _ = method.step(problem, state)
    assert method.converged(state)
    return state


def test_longer_windows_begin_where_shorter_ones_do_and_share_no_reading(pendulum):
    shorter, longer = searches_of(problem_of(pendulum))
    assert set(longer.rows) <= set(shorter.rows)
    assert (np.diff(longer.rows) >= 16).all()
    np.testing.assert_array_equal(longer.states[0], [shorter.states[0, shorter.rows == row][0] for row in longer.rows])


def test_they_go_on_from_the_states_that_were_found(pendulum):
    shorter, longer = searches_of(problem_of(pendulum))
    found = replace(shorter, unit=np.full((1, 3), 0.3), states=shorter.rows[None, :, None] + np.array([0.0, 0.5]))
    first = begun(longer, found)
    np.testing.assert_array_equal(first.unit, [[0.3, 0.3, 0.3]])
    np.testing.assert_array_equal(first.states, longer.rows[None, :, None] + np.array([0.0, 0.5]))
    assert difference(layout(first), layout(longer)) is None


def test_too_few_longer_windows_are_none(pendulum):
    problem = problem_of(pendulum, rows=200)
    shorter = EstimatedStates(5, "cauchy", 40, 1, 4, 2, 1e-7).init(problem, jax.random.key(0))
    assert lengthened(problem, shorter, 15, 3) is None
    assert lengthened(problem, shorter, 10_000, 3) is None


def test_longer_windows_explain_as_well_if_no_channel_is_noisier(pendulum):
    shorter, longer = searches_of(problem_of(pendulum))
    shorter = replace(shorter, deviation=np.array([1.0, 2.0]), explained=len(shorter.rows))
    longer = replace(longer, deviation=np.array([1.1, 2.3]), explained=len(longer.rows))
    assert explain_as_well(longer, shorter)
    assert not explain_as_well(replace(longer, deviation=np.array([1.0, 2.5])), shorter)
    assert explain_as_well(replace(longer, deviation=np.array([1.0, 2.5])), shorter, 2.0)
    assert not explain_as_well(replace(longer, explained=len(longer.rows) // 2), shorter)


def test_where_motion_is_smooth_they_make_noise_matter_less(pendulum):
    problem, space = problem_of(pendulum), pendulum.parameters
    truth = space.vector(dict(zip(space.names, TRUTH, strict=True)))
    widths = []
    for horizon in (horizon_of(problem.dataset), None):
        method = LeastSquares(horizon=horizon)
        state = ended(method, problem)
        interval = method.estimate(problem, state).interval
        assert ((interval[:, 0] <= truth) & (truth <= interval[:, 1])).all()
        widths.append(interval[:, 1] - interval[:, 0])
    assert state.found == len(state.estimated) - 1 > 0
    assert (widths[1] < 0.5 * widths[0]).all()
    # A killed run begins with what `init` makes: the layout has to stay.
    assert difference(layout(state), layout(method.init(problem, jax.random.key(0)))) is None


def test_what_the_model_does_wrong_ends_them(pendulum, tmp_path):
    machine = tmp_path / "machine"
    machine.mkdir()
    rough = PENDULUM.replace('damping="0.1"', 'damping="0.1" frictionloss="0.5"')
    assert rough != PENDULUM
    of_machine = problem_of(robots.load(write_robot(machine, PENDULUM_SPEC, pendulum=rough)).task, noise=0.0)
    problem = CalibrationProblem(of_machine.dataset, simulation.make(pendulum, threads=1))
    state = ended(LeastSquares(), problem)
    assert state.found == 0
    assert state.estimated[1].epochs > 0
