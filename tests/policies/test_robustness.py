"""Returns over draws and costs of errors, on a cart on a spring whose returns are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from madoc import simulation
from madoc.parameters import Parameter
from madoc.policies import NormalParameters, costs_of_errors, over_draws
from robots import spring

KEY = jax.random.key(0)
MASS = Parameter("body_mass", "cart", 1.0, 3.0)
STIFFNESS = Parameter("jnt_stiffness", "slide", 1.0, 9.0)


def push(observation, key=None):
    """Full force forward."""
    return jnp.ones((*observation.shape[:-1], 1))


@pytest.fixture(scope="module")
def simulator():
    return simulation.make(spring(MASS, STIFFNESS))


def test_an_error_costs_what_the_return_loses(simulator):
    """The return is how far the cart is pushed: a lighter cart gets farther, one at the end of its range no lighter."""
    estimate = np.array([2.0, 5.0])
    costs = costs_of_errors(push, simulator, estimate, np.array([0.5, 0.0]), key=KEY, episodes=8)
    mass, stiffness = costs["body_mass.cart"], costs["jnt_stiffness.slide"]
    assert mass.half_width == 0.5
    assert mass.below < -5 * mass.below_error < 0
    assert mass.above > 5 * mass.above_error > 0
    assert mass.largest == mass.above
    assert (stiffness.below, stiffness.above, stiffness.below_error) == (0.0, 0.0, 0.0)
    at_the_end = costs_of_errors(push, simulator, np.array([1.0, 5.0]), np.array([0.5, 0.0]), key=KEY, episodes=8)
    assert at_the_end["body_mass.cart"].below == 0.0


def test_the_worst_tenth_of_the_draws(simulator):
    sure = NormalParameters(simulator.parameters, np.array([2.0, 5.0]), np.zeros((2, 2)))
    found = over_draws(push, simulator, sure, key=KEY, draws=20)
    assert (found.mean, found.worst_tenth) == pytest.approx((found.at_estimate, found.at_estimate), rel=1e-12)
    unsure = NormalParameters(simulator.parameters, np.array([2.0, 5.0]), np.diag([0.09, 0.0]))
    found = over_draws(push, simulator, unsure, key=KEY, draws=20)
    assert found.draws == 20
    heavy = costs_of_errors(push, simulator, np.array([2.0, 5.0]), np.array([0.3, 0.0]), key=KEY, episodes=8)
    assert found.at_estimate - found.worst_tenth > heavy["body_mass.cart"].above
