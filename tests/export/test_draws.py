"""Draws of models as a table: their covariance, and that a row put into a model is that model bound."""

import importlib.util

import gymnasium
import jax
import mujoco
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.export import save_draws
from madoc.policies.systems import NormalParameters
from madoc.simulation.drawn import numbers_of_draws
from own_robots import SPRING_SPEC, write_robot
from robots import SPRING_TRUTH


@pytest.fixture
def simulator(tmp_path):
    return simulation.make(robots.load(write_robot(tmp_path, SPRING_SPEC)).task, threads=1)


def used(folder):
    spec = importlib.util.spec_from_file_location("draws", folder / "draws.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_drawn_models_have_the_covariance_of_the_estimate_and_are_those_bound(simulator, tmp_path):
    space = simulator.parameters
    mean, spread = space.vector(SPRING_TRUTH), 0.02 * (space.high - space.low)
    correlation = np.full((len(space), len(space)), 0.8) + 0.2 * np.eye(len(space))
    covariance = correlation * np.outer(spread, spread)
    values = np.asarray(NormalParameters(space, mean, covariance).draw(jax.random.key(0), 1000))
    save_draws(tmp_path, space.names, (), values, numbers_of_draws(simulator, values))
    draws = used(tmp_path)
    assert draws.count() == 1000 and draws.around() == []
    model, put = simulator.task.compile(), []
    for row in range(1000):
        told = draws.put(model, row)
        put.append([model.jnt_stiffness[0], model.dof_damping[0], model.body("cart").mass[0]])
    wanted = {"jnt_stiffness.slide": 0, "dof_damping.slide": 1, "body_mass.cart": 2}
    order = [wanted[name] for name in space.names]
    found = np.cov(np.array(put)[:, order], rowvar=False)
    np.testing.assert_allclose(found, covariance, rtol=0.2)  # three standard errors of a variance by 1000 draws
    assert told == pytest.approx(dict(zip(space.names, values[-1], strict=True)))
    bound = simulator.model(values[-1])
    for field in ("body_mass", "body_inertia", "dof_M0", "dof_invweight0", "body_subtreemass", "jnt_stiffness"):
        np.testing.assert_array_equal(getattr(model, field), getattr(bound, field), err_msg=field)
    moved = [mujoco.MjData(each) for each in (model, bound)]
    for each, data in zip((model, bound), moved, strict=True):
        data.qpos[0] = 0.3
        mujoco.mj_step(each, data, 50)
    assert moved[0].qpos[0] == moved[1].qpos[0]


def test_a_gymnasium_environment_has_another_draw_in_every_episode(simulator, tmp_path):
    mean = simulator.parameters.vector(SPRING_TRUTH)
    values = mean + 0.1 * np.arange(20)[:, None]
    save_draws(tmp_path, simulator.parameters.names, (), values, numbers_of_draws(simulator, values))

    class Environment(gymnasium.Env):
        model = simulator.task.compile()

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return np.zeros(1), {}

    environment = used(tmp_path).randomized(Environment())
    seen = []
    for seed in (3, None, 3, None):
        environment.reset(seed=seed)
        seen.append(float(environment.unwrapped.model.jnt_stiffness[0]))
    assert seen[0] == seen[2] and seen[1] == seen[3] and seen[0] != seen[1]
