"""Draws of models as a table: their covariance, and that a row put into a model is that model bound."""

import importlib.util
from dataclasses import dataclass, replace

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.export.draws import save_draws
from madoc.policies.base import NormalParameters
from madoc.simulation.mjcf import numbers_of_draws
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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Option:
    gravity: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Model:
    """As much of an mjx.Model as `domain_randomize` uses."""

    dof_damping: jax.Array
    body_inertia: jax.Array
    body_mass: jax.Array
    opt: Option

    def tree_replace(self, changed):
        inside = {name.removeprefix("opt."): part for name, part in changed.items() if name.startswith("opt.")}
        own = {name: part for name, part in changed.items() if not name.startswith("opt.")}
        return replace(self, **own, opt=replace(self.opt, **inside))


def test_playground_gets_whole_rows_and_is_told_which_arrays_have_them(tmp_path):
    """Row k of the table is 1 + k in every array: a model of two rows mixed would show two numbers."""
    one = 1.0 + np.arange(50.0)[:, None]
    places = {"dof_damping": [1], "body_inertia": [0, 5], "opt.gravity": [2], "geom_of_later_versions": [0]}
    numbers = {name: (np.array(at), np.repeat(one, len(at), 1)) for name, at in places.items()}
    save_draws(tmp_path, ("a",), (), one, numbers | {"geom_contype": (np.array([0]), np.ones((50, 1), int))})
    own = Model(jnp.zeros(2), jnp.zeros((2, 3)), jnp.ones(2), Option(jnp.zeros(3)))
    keys = jax.random.split(jax.random.key(0), 30)
    drawn, in_axes = used(tmp_path).domain_randomize(own, keys)
    assert (in_axes.dof_damping, in_axes.body_inertia, in_axes.body_mass, in_axes.opt.gravity) == (0, 0, None, 0)
    seen = jax.vmap(lambda model: jnp.concatenate([part.ravel() for part in jax.tree.leaves(model)]), (in_axes,))(drawn)
    row = np.asarray(drawn.dof_damping[:, 1])
    assert len(set(row.tolist())) > 15 and set(row.tolist()) <= set(one[:, 0].tolist())
    still = [[0.0, value, value, 0, 0, 0, 0, value, 1, 1, 0, 0, value] for value in row]
    np.testing.assert_array_equal(seen, still)


def test_mjx_takes_the_rows_as_its_own_models(simulator, tmp_path):
    mjx = pytest.importorskip("mujoco.mjx", reason="mujoco-mjx is not installed")
    values = simulator.parameters.vector(SPRING_TRUTH) + 0.1 * np.arange(20)[:, None]
    save_draws(tmp_path, simulator.parameters.names, (), values, numbers_of_draws(simulator, values))
    draws = used(tmp_path)
    model = simulator.task.compile()
    drawn, in_axes = draws.domain_randomize(mjx.put_model(model), jax.random.split(jax.random.key(0), 8))
    stiffness = []
    for row in range(draws.count()):
        draws.put(model, row)
        stiffness.append(model.jnt_stiffness[0])
    for index, found in enumerate(np.asarray(drawn.jnt_stiffness[:, 0])):
        draws.put(model, int(np.argmin(np.abs(np.array(stiffness) - found))))
        alone, of_batch = mjx.put_model(model), jax.vmap(lambda each: each, (in_axes,))(drawn)
        for field in ("body_mass", "body_inertia", "dof_damping", "dof_invweight0", "jnt_stiffness"):
            np.testing.assert_allclose(getattr(of_batch, field)[index], getattr(alone, field), rtol=1e-6, err_msg=field)
