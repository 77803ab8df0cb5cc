"""A shorter timestep is tried at the end of a search, and counts where the log is likelier with it."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import calibrate, robots, simulation
from madoc.calibration import CalibrationProblem
from madoc.calibration.least_squares import timestep
from madoc.calibration.least_squares.calibrator import LeastSquares
from madoc.runs.checkpoint import layout, load, save
from own_robots import write_robot
from robots import counted, recorded

ROD = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><position name="goal" joint="hinge" kp="40" kv="1"/></actuator>
</mujoco>
"""
ROD_SPEC = """\
madoc: 1
name: servo
model: rod.xml
control_step: 0.02
signals:
  - {name: angle, reads: position(hinge)}
  - {name: speed, reads: velocity(hinge)}
actions:
  - {name: goal, actuator: goal, low: -1, high: 1}
parameters:
  - {field: dof_damping, element: hinge, name: damping, low: 0, high: 1}
  - {field: body_mass_and_inertia, element: rod, name: mass, low: 0.5, high: 2}
"""
TRUTH = {"damping": 0.4, "mass": 0.8}


def problem_of(folder, substeps):
    """A log with noise of a rod whose plant takes so many steps in one of the model's."""
    task = robots.load(write_robot(folder, ROD_SPEC, rod=ROD)).task
    plant = task if substeps == 1 else task.with_time_step(1.0 / substeps, substeps=substeps)
    log = recorded(plant, TRUTH, 600, jax.random.key(0))
    random, rows = np.random.default_rng(0), log.transitions
    error = random.standard_normal((len(log) + 1, 2)) * [1e-3, 1e-2]
    noisy = replace(rows, observation=rows.observation + error[:-1], next_observation=rows.next_observation + error[1:])
    return CalibrationProblem(replace(log, transitions=noisy), simulation.make(task, threads=1))


@pytest.mark.parametrize(("substeps", "timesteps"), [(1, 1), (4, 4)])
def test_the_timestep_is_the_likelier_one(tmp_path, substeps, timesteps):
    problem = problem_of(tmp_path, substeps)
    result = calibrate(LeastSquares(), problem, key=jax.random.key(0), budget="60s", quiet=True)
    assert result.settled and result.timesteps == timesteps
    for name, true in TRUTH.items():
        low, high = result.parameters[name].interval
        assert low <= true <= high
    told = [
        note for note in result.notes if "likelier with a timestep of 0.0025 s than with the model's of 0.01 s" in note
    ]
    assert len(told) == (timesteps > 1)


def test_a_trial_keeps_the_estimate_until_its_end_and_gives_it_back_if_in_vain(tmp_path):
    problem, method = problem_of(tmp_path, 1), LeastSquares()
    state = method.init(problem, jax.random.key(0))
    while not state.trying:
        own, (state, _) = state, method.step(problem, state)
    kept = method.estimate(problem, state)
    np.testing.assert_array_equal(kept.mean, method.estimate(problem, method.step(problem, own)[0]).mean)
    (tried, epoch), spent = counted(method.step, problem, state)
    assert epoch.control_steps == spent and spent % timestep.FINER == 0
    assert tried.trying and (tried.unknown[0].point[0] != state.unknown[0].point[0]).any()
    np.testing.assert_array_equal(method.estimate(problem, tried).mean, kept.mean)
    while tried.trying:
        tried, _ = method.step(problem, tried)
    assert tried.timesteps == 1 and tried.searched and layout(tried) == layout(state) == layout(own)
    np.testing.assert_array_equal(method.estimate(problem, tried).mean, kept.mean)


def test_a_trial_that_was_stopped_goes_on_to_the_same_bits(tmp_path):
    problem, method = problem_of(tmp_path, 4), LeastSquares()
    state = method.init(problem, jax.random.key(0))
    while not state.trying:
        state, _ = method.step(problem, state)
    save(tmp_path / "state.npz", state, {})
    states = [state, load(tmp_path / "state.npz", method.init(problem, jax.random.key(0)))[0]]
    problems = problem, problem_of(tmp_path, 4)
    for _ in range(3):
        states = [method.step(given, each)[0] for given, each in zip(problems, states, strict=True)]
    for one, other in zip(*map(jax.tree.leaves, states), strict=True):
        np.testing.assert_array_equal(one, other)


def test_longer_windows_that_leave_noise_with_a_shorter_timestep_alone_decide(tmp_path):
    """As likely by the shortest windows, it is taken only where the own adds up and this one is known not to."""
    problem = problem_of(tmp_path, 1)
    state = LeastSquares().init(problem, jax.random.key(0))
    own = replace(state, stage="lengthening", finished=1, of_own=None)
    tried = replace(own, of_own=own, trying=1)
    for before, after, timesteps in ((True, False, 4), (True, None, 1), (True, True, 1), (False, False, 1)):
        said = {id(tried.of_own): before, id(tried): after}
        found = timestep.followed(problem, tried, 5, lambda of, said=said: said[id(of)])
        assert (found.timesteps, found.trying) == (timesteps, 0)


def test_less_noise_is_likelier_by_as_many_readings_as_tell_it(tmp_path):
    """By hand: a channel has a hundredth less noise, ln 1 / 0.99 = 0.01005; to gain ten takes 995 readings of each."""
    state = LeastSquares().init(problem_of(tmp_path, 1), jax.random.key(0))
    first = replace(state.unknown[0], deviation=np.array([1.0, 2.0]), explained=199)
    own = replace(state, stage="estimated", unknown=(first, *state.unknown[1:]))
    less = replace(own, unknown=(replace(first, deviation=np.array([0.99, 2.0])), *state.unknown[1:]))
    assert timestep.likelier(own, less, 5) and not timestep.likelier(less, own, 5)
    assert not timestep.likelier(own, replace(less, unknown=(replace(less.unknown[0], explained=198),)), 5)
