"""An ensemble filter worked by hand, and its prediction errors."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from known_errors import known
from madoc import simulation
from madoc.calibration import CalibrationProblem
from madoc.data import Disturbance, disturb
from madoc.data.velocities import dof_names
from madoc.identification.ensembles import few_of, members_at
from madoc.identification.innovations import FARTHEST, Correction, innovations
from madoc.identification.random_forces import by_dof, opposed
from madoc.identification.replay import Readings
from robots import SPRING_TRUTH, recorded, spring


def test_states_follow_a_reading_by_kalmans_gain():
    """By hand: two states with a variance of 2 and a reading of noise 1 that is 2 below them: K = 2/3, P = 2/3."""
    states, apart = np.array([4.0, 2.0]).reshape(1, 1, 2, 1), np.array([3.0, 1.0]).reshape(1, 1, 2, 1)
    correction = Correction.of(states[0], apart[0])
    assert correction.factor == pytest.approx(np.sqrt(3.0))
    after = correction.follow(states, apart)
    assert after.mean() == pytest.approx(3.0 - 2.0 * 2.0 / 3.0)
    assert after.var(ddof=1) == pytest.approx(2.0 / 3.0)
    far = Correction.of(states[0], apart[0] + 1000.0)
    false = far.follow(states, apart + 1000.0)
    assert false.mean() == pytest.approx(3.0 - FARTHEST * 2.0 / np.sqrt(3.0))
    both = far.follow(np.concatenate([states, states]), np.concatenate([apart + 1000.0, apart + 500.0]))
    assert 3.0 - both[1].mean() == pytest.approx(0.5 * (3.0 - both[0].mean()), rel=0.01)  # the first system decides
    one = correction.follow(states[..., :1, :], apart[..., :1, :])  # a single state follows by the ensemble's gain
    assert one.item() == pytest.approx(4.0 - 3.0 * 2.0 / 3.0)


def test_prediction_errors_of_the_right_model_are_white_and_of_variance_one():
    task = spring(max_episode_steps=100)
    log = disturb(recorded(task, SPRING_TRUTH, 600, jax.random.key(0)), Disturbance(noise=0.1), task, jax.random.key(1))
    problem = CalibrationProblem(replace(log, disturbance=Disturbance()), simulation.make(task, threads=1))
    rows = np.arange(0, 600, 25)
    readings = Readings.at(problem.dataset, problem.states, rows, 20, problem.typical_change)
    noise = 0.1 * np.ones(len(readings.scale))
    random = np.random.default_rng(0)
    members = members_at(problem.dataset, problem.states, problem.simulator, rows, noise * readings.scale, 200, random)
    around = members - problem.states.states[np.searchsorted(problem.states.rows, rows)][:, None]
    np.testing.assert_allclose(around.std((0, 1)), noise * readings.scale, rtol=0.05)
    truth = task.parameters.to_unit(task.parameters.vector(SPRING_TRUTH))
    found = innovations(problem.simulator, readings, np.stack([truth, -truth]), members, noise)
    errors = found.whitened[0]
    assert found.whole.all()
    assert errors.var() == pytest.approx(1.0, rel=0.1)
    assert abs((errors[:, 1:] * errors[:, :-1]).mean()) < 0.1
    surprise = found.surprise("linear").mean(1)
    assert surprise[0] < surprise[1]
    few = few_of(members, 50, problem.states.physical_size)
    again = innovations(problem.simulator, readings, truth[None], few, noise, like=found)
    np.testing.assert_allclose(again.mean[0], found.mean[0], atol=1e-6)  # where motion is linear few say the same


def test_readings_are_as_likely_as_their_errors_and_what_was_expected_of_them():
    """By hand: an error of 2 standard deviations and one far off, clipped at 3, of a channel whose noise is 0.5."""
    errors = np.zeros((1, 2, 1, 2))
    errors[0, :, 0, 0] = 2.0, 9.0  # the second channel's are all 0, and do not count
    found = replace(known(errors), noise=np.array([0.5, 7.0]))
    np.testing.assert_allclose(found.misfit(), np.log(0.5) + np.array([2.0, 4.5]))
    assert np.isnan(replace(found, mean=0.0 * errors, whole=np.zeros((1, 2), bool)).misfit()).all()


def test_errors_that_state_and_action_explain_are_not_noise():
    """Errors of three channels, the last always 0: half of the second's variance is that of an action, or of a sign."""
    random, every = np.random.default_rng(0), np.ones(40, bool)
    errors, actions = random.standard_normal((1, 40, 15, 3)), random.standard_normal((40, 15, 1))
    errors[..., 2] = 0.0
    found = replace(known(errors), before=random.standard_normal((40, 15, 2)))
    assert found.explained_by(actions, every) < 0.03
    errors = errors.copy()
    errors[0, ..., 1] += actions[..., 0]
    driven = replace(found, mean=errors.copy())
    assert driven.explained_by(actions, every) == pytest.approx(0.5, abs=0.07)
    assert driven.explained_by(actions, np.arange(40) < 13) == 0.0  # 195 readings do not tell
    errors[0, ..., 1] += np.sign(found.before[..., 0]) - actions[..., 0]
    assert replace(found, mean=errors).explained_by(actions, every) > 0.3
    forces = np.stack([random.standard_normal((40, 15)), 3.0 * actions[..., 0] + random.standard_normal((40, 15))], -1)
    assert replace(found, pushed=1e-3 * forces).explained_by(actions, every) == pytest.approx(0.9, abs=0.03)
    assert replace(found, pushed=forces[..., :1]).explained_by(actions, every) < 0.03
    assert (
        replace(found, mean=errors, pushed=forces[..., :1]).explained_by(actions, every) > 0.3
    )  # errors count as well


def test_what_readings_tell_of_random_forces_is_their_mean_given_these():
    """Of a slide that is read almost without noise each reading tells the force, which is at random."""
    task = spring(max_episode_steps=100)
    log = recorded(task, SPRING_TRUTH, 600, jax.random.key(0), force=0.3)
    problem, simulator = CalibrationProblem(log, simulation.make(task, threads=1)), simulation.make(task, threads=1)
    rows = np.arange(0, 600, 20)
    readings = Readings.at(log, problem.states, rows, 18, problem.typical_change)
    truth = task.parameters.to_unit(task.parameters.vector(SPRING_TRUTH))
    members = np.repeat(problem.states.states[rows][:, None], 40, axis=1)
    forces = opposed(np.array([0.3]), len(rows), 40, 18, np.random.default_rng(0))
    assert forces.mean(1) == pytest.approx(0.0, abs=1e-15) and forces.std() == pytest.approx(0.3, rel=0.02)
    found = innovations(simulator, readings, truth[None], members, 1e-4 * np.ones(2), forces=forces)
    told = found.pushed[:, :, 0]
    assert told.std() == pytest.approx(0.3, rel=0.2)
    assert found.explained_by(readings.actions, np.ones(len(rows), bool)) < 0.05
    system = simulator.bind(simulator.parameters.to_physical(truth)[None])
    state, after = (problem.states.states[rows + each][None] for each in (0, 1))
    every = None, np.ones((1, len(rows), 1))
    alone, pushed = (system.step(state, readings.actions[None, :, 0], each) for each in every)
    exact = ((after - alone) / (pushed - alone))[0, :, 1]
    np.testing.assert_allclose(told[:, 0], exact, atol=1e-3)
    assert by_dof(simulator, 0.3) == pytest.approx(0.3 * np.sqrt(task.model.dof_M0)) and not len(by_dof(simulator, 0.0))
    assert dof_names(task) == ["slide"]


def test_predictions_leave_errors_alike_only_where_windows_agree():
    """Errors of one channel that are noise, of a second that lasts, and of a third that lasts in one window."""
    random = np.random.default_rng(0)
    errors = random.standard_normal((1, 40, 30, 3))
    errors[..., 1] += 1.5 * random.standard_normal((1, 40, 1))
    found = known(errors)
    clipped = np.clip(errors[0, ..., 1], -3.0, 3.0)
    pairs = (clipped[:, 1:] * clipped[:, :-1]).mean(1) / (clipped**2).mean()
    assert found.alike() == pytest.approx(pairs.mean() - 2.0 * pairs.std(ddof=1) / np.sqrt(40))
    assert 0.4 < found.alike() < 0.6
    errors[..., 1], errors[0, 0, :, 2] = errors[..., 0], 2.9
    assert replace(found).alike() < 0.1  # the third has a correlation of 0.2 that one window makes
