import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from affine import affine
from madoc.learning.cloning import cloning_loss
from madoc.learning.tanh_gaussian import TanhGaussianPolicy


def start(optimiser, hidden=(32, 32)):
    policy = TanhGaussianPolicy(1, 2, hidden, key=jax.random.key(0))
    return policy, optimiser.init(eqx.filter(policy, eqx.is_array))


def behaviour(observation):
    """Mean and std before squashing of a known behaviour, two motors; the second one's noise grows with s."""
    mean = np.concatenate([0.8 * observation, 0.3 - 0.2 * observation], axis=-1)
    std = np.concatenate([np.full_like(observation, 0.3), 0.4 + 0.2 * observation], axis=-1)
    return mean, std


@pytest.fixture(scope="module")
def logged():
    random = np.random.default_rng(0)
    observation = random.uniform(-1, 1, (20_000, 1))
    mean, std = behaviour(observation)
    action = np.tanh(mean + std * random.normal(size=mean.shape))
    return jnp.asarray(observation, jnp.float32), jnp.asarray(action, jnp.float32)


def test_cloning_loss_by_hand(compiled):
    policy = TanhGaussianPolicy(1, 1, (), key=jax.random.key(0))
    policy = eqx.tree_at(lambda policy: policy.network, policy, affine([[0.5], [0]], [0, np.log(2)]))
    # s = 1: N(0.5, 2²), a = tanh 1: log density -0.775774 (see test_tanh_gaussian)
    # s = 0: N(0, 2²), a = 0: -log 2 - 0.918939 = -1.612086; minus the mean of both is 1.193930
    loss = compiled(cloning_loss)(policy, jnp.array([[1.0], [0.0]]), jnp.array([[np.tanh(1.0)], [0.0]]))
    assert loss == pytest.approx(1.193930, rel=1e-5)


def test_clone_recovers_mean_and_noise(logged):
    optimiser = optax.adam(3e-3)
    policy, optimiser_state = start(optimiser)
    policy, _, metrics = clone(
        policy, optimiser_state, logged, jax.random.key(1), optimiser=optimiser, batch=256, count=1500
    )
    observation = np.linspace(-0.9, 0.9, 10)[:, None]
    mean, log_std = policy.distribution(jnp.asarray(observation, jnp.float32))
    true_mean, true_std = behaviour(observation)
    np.testing.assert_allclose(mean, true_mean, atol=0.06)
    np.testing.assert_allclose(np.exp(log_std), true_std, rtol=0.15)
    assert np.isfinite(metrics["cloning_loss"])


def test_clone_traces_once_and_counts_its_updates(logged, traced):
    optimiser = optax.adam(1e-3)
    policy, optimiser_state = start(optimiser, hidden=(4,))
    settings = {"optimiser": optimiser, "batch": 16, "count": 3}
    keys = list(jax.random.split(jax.random.key(1), 11))
    policy, optimiser_state, _ = clone(policy, optimiser_state, logged, keys[0], **settings)
    before = traced()
    for key in keys[1:]:
        policy, optimiser_state, _ = clone(policy, optimiser_state, logged, key, **settings)
    assert traced() == before
    assert optimiser_state[0].count == 33


def test_the_same_key_clones_the_same(logged):
    optimiser = optax.adam(1e-3)
    policy, optimiser_state = start(optimiser, hidden=(4,))
    settings = {"optimiser": optimiser, "batch": 16, "count": 3}
    first, _, _ = clone(policy, optimiser_state, logged, jax.random.key(5), **settings)
    again, _, _ = clone(policy, optimiser_state, logged, jax.random.key(5), **settings)
    other, _, _ = clone(policy, optimiser_state, logged, jax.random.key(6), **settings)
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert not np.array_equal(first.network.layers[0].weight, other.network.layers[0].weight)
