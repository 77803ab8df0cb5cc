import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from affine import affine
from madoc.learning.cloning import cloning_epoch, cloning_loss, continue_cloning, fresh_clone
from madoc.learning.tanh_gaussian import TanhGaussianPolicy

FEW = {"learning_rate": 1e-3, "batch": 16, "updates": 3}


def fresh(logged, hidden, learning_rate):
    return fresh_clone(logged, hidden, learning_rate=learning_rate, key=jax.random.key(0))


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
    clone, metrics = continue_cloning(
        fresh(logged, (32, 32), 3e-3), logged, jax.random.key(1), learning_rate=3e-3, batch=256, updates=1500
    )
    policy = clone.policy
    observation = np.linspace(-0.9, 0.9, 10)[:, None]
    mean, log_std = policy.distribution(jnp.asarray(observation, jnp.float32))
    true_mean, true_std = behaviour(observation)
    np.testing.assert_allclose(mean, true_mean, atol=0.06)
    np.testing.assert_allclose(np.exp(log_std), true_std, rtol=0.15)
    assert np.isfinite(metrics["cloning_loss"])


def test_clone_traces_once_and_counts_its_updates(logged, traced):
    keys = list(jax.random.split(jax.random.key(1), 11))
    clone, _ = continue_cloning(fresh(logged, (4,), 1e-3), logged, keys[0], **FEW)
    before = traced()
    for key in keys[1:]:
        clone, _ = continue_cloning(clone, logged, key, **FEW)
    assert traced() == before
    assert clone.epochs == 11
    assert clone.optimiser[0].count == 33


def test_the_same_key_clones_the_same(logged):
    begun = fresh(logged, (4,), 1e-3)
    first, again, other = (continue_cloning(begun, logged, jax.random.key(seed), **FEW)[0].policy for seed in (5, 5, 6))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert not np.array_equal(first.network.layers[0].weight, other.network.layers[0].weight)


def test_an_epoch_of_cloning_is_a_part_of_its_stage(logged):
    begun, given = fresh(logged, (4,), 1e-3), jax.random.key(5)
    of_batches, rest = jax.random.split(given)
    same, metrics = continue_cloning(begun, logged, of_batches, **FEW)
    clone, key, epoch = cloning_epoch(begun, logged, given, epochs=4, **FEW)
    jax.tree.map(np.testing.assert_array_equal, clone.policy, same.policy)
    np.testing.assert_array_equal(jax.random.key_data(key), jax.random.key_data(rest))
    assert (epoch.stage, epoch.fraction, epoch.metrics) == ("cloning", 0.25, metrics)
