"""CQL's regulariser by hand, and against its definition by numerical integration."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

from affine import affine, layered
from madoc.learning.sac_losses import TwinCritic
from madoc.learning.tanh_gaussian import TanhGaussianPolicy, log_density
from madoc.policies.cql import conservative_gap, cql_loss, log_integral, proposals


def twins(first, second):
    made = TwinCritic(1, 1, (), key=jax.random.key(0))
    return eqx.tree_at(lambda critic: (critic.first, critic.second), made, (first, second))


def policy_of(slope, mean, std):
    made = TanhGaussianPolicy(1, 1, (), key=jax.random.key(0))
    return eqx.tree_at(lambda policy: policy.network, made, affine([[slope], [0]], [mean, np.log(std)]))


def column(numbers):
    return jnp.asarray(numbers, jnp.float32)[:, None]


def test_log_integral_by_hand(compiled):
    # Q = (1, 2), densities (1/2, 1/4): log of mean(2e, 4e²) = log((5.436564 + 29.556224) / 2) = 2.861995
    # Q = (0, 0), densities (1, 1): log 1 = 0
    value = jnp.array([[1.0, 0.0], [2.0, 0.0]])
    density = jnp.array([[np.log(0.5), 0.0], [np.log(0.25), 0.0]])
    np.testing.assert_allclose(compiled(log_integral)(value, density), [2.861995, 0.0], atol=1e-5)


def test_proposals_know_their_densities(compiled):
    policy = policy_of(0.5, 0.2, 0.6)
    here, there = column([1.0, -1.0]), column([3.0, 0.0])
    actions, density = compiled(lambda key: proposals(policy, here, there, samples=4, key=key))(jax.random.key(1))
    assert actions.shape == (12, 2, 1)
    assert (abs(actions) <= 1).all()
    np.testing.assert_allclose(density[:4], np.log(0.5), rtol=1e-6)
    for part, state in ((slice(4, 8), here), (slice(8, 12), there)):
        wanted = [log_density(row, *policy.distribution(state)) for row in actions[part]]
        np.testing.assert_allclose(density[part], wanted, rtol=1e-3, atol=1e-3)


def test_regulariser_is_its_definition_by_brute_force():
    """E[log ∫ exp Q(s, a) da - Q(s, a of the data)] for a curved Q of one action, integrated on a grid by SciPy."""
    layers = ([[0.3, 2.0], [-0.4, -3.0]], [0.2, 0.5]), ([[1.0, -0.7]], [0.4])
    critic = twins(layered(*layers), layered(*layers))

    def value(state, action):
        hidden = np.maximum(np.array(layers[0][0]) @ [state, action] + layers[0][1], 0)
        return float((np.array(layers[1][0]) @ hidden)[0] + 0.4)

    states, logged = [1.0, -0.5], [0.3, -0.8]
    exact = [
        np.log(integrate.quad(lambda action, state=state: np.exp(value(state, action)), -1, 1, limit=200)[0])
        - value(state, action)
        for state, action in zip(states, logged, strict=True)
    ]
    observation, action = column(states), column(logged)
    proposed = proposals(
        policy_of(0.4, 0.1, 0.7), observation, column([0.5, 2.0]), samples=30_000, key=jax.random.key(0)
    )
    gap = eqx.filter_jit(conservative_gap)(critic, observation, action, proposed)
    assert gap == pytest.approx(2 * np.mean(exact), abs=0.02)  # both twins are the same


def test_gradient_is_the_soft_maximum_less_the_data():
    """d gap / d Q is softmax(Q - log density) on proposals and -1 on the data's action, per row."""
    value, density = jnp.array([[1.0], [3.0]]), jnp.array([[-0.5], [0.5]])
    slope = jax.grad(lambda value: log_integral(value, density).sum())(value)
    weights = np.exp([1.5, 2.5])
    np.testing.assert_allclose(slope[:, 0], weights / weights.sum(), rtol=1e-5)


def test_loss_by_hand(compiled):
    # Q = s + 2a + 0.5 and -s + a + 3; row (1, 0.5): values 2.5, 2.5; target 2 -> squared errors 0.25 each
    # one proposal, a = -1 of density 1/2: Q = -0.5 and 1; log ∫ = Q + log 2; gaps -3 + log 2, -1.5 + log 2
    critic = twins(affine([[1, 2]], [0.5]), affine([[-1, 1]], [3]))
    proposed = jnp.array([[[-1.0]]]), jnp.array([[np.log(0.5)]], jnp.float32)
    loss, gap = compiled(
        lambda critic: cql_loss(critic, column([1.0]), column([0.5]), jnp.array([2.0]), proposed, weight=5.0)
    )(critic)
    assert gap == pytest.approx(-4.5 + 2 * np.log(2), rel=1e-5)
    assert loss == pytest.approx(0.5 + 5 * (-4.5 + 2 * np.log(2)), rel=1e-5)
