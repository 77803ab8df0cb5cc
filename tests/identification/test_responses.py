"""Effects of forces by derivatives of single steps, beside simulations of them."""

from dataclasses import replace

import numpy as np
import pytest
from test_noise import body_task

from madoc import simulation
from madoc.identification.replay import Readings
from madoc.identification.responses import responses_of
from robots import counted, spring

WHOLE = np.ones(2, bool)


def of_windows(task, actions):
    simulator, size = simulation.make(task, threads=1), task.observation_size
    observed = np.zeros((len(actions), actions.shape[1] + 1, size))
    spread = np.ones(task.model.nq + task.model.nv)
    return simulator, Readings(actions, observed, np.full(size, 0.5), spread)


def test_a_force_on_a_free_body_adds_up_by_hand(tmp_path):
    """1 N on 1 kg for steps of 0.02 s: after k of them 0.02 k m/s, and 0.02² k (k + 1) / 2 m, without damping."""
    task = body_task(tmp_path)
    state = np.concatenate([[0.0, 0.0, 1.0, np.cos(0.4), 0.0, 0.0, np.sin(0.4)], np.zeros(6)])
    simulator, readings = of_windows(task, np.zeros((2, 3, 1)))
    states = np.stack([state, state])
    responses, steps_taken = counted(responses_of, simulator, readings, -np.ones(1), states, WHOLE)
    forces = np.zeros((2, 3, 6, 1))
    forces[:, :, 0] = 1.0
    found = responses.effects(forces).reshape(2, 4, 13)[0]
    steps = np.arange(4)
    assert found[:, 0] == pytest.approx(0.02**2 * steps * (steps + 1) / 2 / 0.5, abs=1e-9)
    assert found[:, 7] == pytest.approx(0.02 * steps / 0.5, abs=1e-9)
    assert np.delete(found, [0, 7], axis=1) == pytest.approx(0.0, abs=1e-9)
    assert steps_taken == (2 + 18) * 2 * 3


def test_effects_are_those_of_small_forces_that_are_simulated(tmp_path):
    random = np.random.default_rng(0)
    for task, size in ((spring(), 1e-4), (body_task(tmp_path), 1e-4)):
        state = simulation.make(task, threads=1).initial_state + 0.3 * random.standard_normal((2, 1))
        simulator, readings = of_windows(task, random.uniform(-1.0, 1.0, (2, 6, 1)))
        point, dofs = np.zeros(len(simulator.parameters)), task.model.nv
        forces = random.standard_normal((2, 6, dofs, 1))
        found = responses_of(simulator, readings, point, state, WHOLE).effects(forces)[..., 0]
        system = simulator.bind(simulator.parameters.middle[None])
        reached = np.concatenate([state[:, None], system.roll_out(state[None], readings.actions[None])[0]], axis=1)
        readings = replace(readings, observed=system.observe(reached))
        base = readings.residuals(simulator, point[None], state[None])[0, 0]
        pushed = readings.residuals(simulator, point[None], state[None], size * forces[None, ..., 0])[0, 0]
        expected = (pushed - base) / size
        assert found == pytest.approx(expected, abs=0.02 * np.abs(expected).max())


def test_a_window_that_does_not_count_has_no_effect():
    task = spring()
    state = np.array([[0.1, 0.0], [np.nan, 0.0]])
    simulator, readings = of_windows(task, np.zeros((2, 3, 1)))
    responses = responses_of(simulator, readings, np.zeros(len(simulator.parameters)), state, np.array([True, False]))
    found = responses.effects(np.where(np.isnan(responses.motion[..., :1, None]), np.nan, np.ones((2, 3, 1, 1))))
    assert (found[1] == 0.0).all()
    assert found[0].any()
