import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from affine import affine
from madoc.learning import dynamics_reward as reward
from madoc.learning.dynamics_ensemble import Ensemble
from madoc.learning.networks import adam


def test_reward_by_hand(compiled):
    # D of logits (0, log 3) is (1/2, 3/4), mean 5/8: -log(3/8) = 0.980829; of (100, 100) it is cut at 0.999
    logits = jnp.array([[0.0, 100.0], [np.log(3.0), 100.0]])
    np.testing.assert_allclose(compiled(reward.dynamics_reward)(logits), [0.980829, -np.log(0.001)], rtol=1e-3)
    assert reward.dynamics_reward(jnp.zeros((3, 1)))[0] == pytest.approx(np.log(2.0))


def test_losses_by_hand(compiled):
    # real logit log 3: -log 3/4; generated log 3: -log 1/4; the generator's is minus that
    logit = jnp.array([np.log(3.0)])
    assert compiled(reward.discriminator_loss)(logit, logit) == pytest.approx(-np.log(0.75) - np.log(0.25), rel=1e-5)
    assert compiled(reward.generator_loss)(logit) == pytest.approx(np.log(0.25), rel=1e-5)


def start(members=3):
    generator = Ensemble(1, 1, (8,), models=1, key=jax.random.key(0))
    return reward.opposition(
        generator, 2, 1, hidden=(16,), members=members, optimiser=adam(1e-3), key=jax.random.key(1)
    )


def test_the_newest_discriminator_pushes_out_the_oldest():
    begun = start()
    marked = eqx.tree_at(lambda parts: parts.discriminator.layers[-1].bias, begun, jnp.array([7.0]))
    past = reward.remember(marked).past.layers[-1].bias[:, 0]
    np.testing.assert_array_equal(past[:2], begun.past.layers[-1].bias[1:, 0])
    assert past[2] == 7.0


def test_past_discriminators_are_averaged():
    nets = [affine([[0.0, 0.0, slope]], [0.0]) for slope in (0.0, np.log(3.0))]
    past = jax.tree.map(lambda *leaves: jnp.stack(leaves) if eqx.is_array(leaves[0]) else leaves[0], *nets)
    found = reward.reward_of(past, jnp.zeros((1, 2)), jnp.ones((1, 1)))
    assert found[0] == pytest.approx(0.980829, rel=1e-5)


def test_real_transitions_earn_more_than_wrong_ones():
    random = np.random.default_rng(0)
    pair = random.normal(size=(3000, 2)).astype(np.float32)
    rows = (jnp.asarray(pair), jnp.asarray(pair[:, :1] - pair[:, 1:]))
    opposition = start(members=5)
    run = eqx.filter_jit(lambda *parts: reward.oppose(*parts, optimiser=adam(1e-3), batch=64, count=100, noise=0.1))
    for key in jax.random.split(jax.random.key(2), 10):
        opposition, metrics = run(opposition, rows, key)
        opposition = reward.remember(opposition)
    assert all(np.isfinite(value) for value in metrics.values())
    right = reward.reward_of(opposition.past, *rows)
    wrong = reward.reward_of(opposition.past, rows[0], rows[1] + 2.0)
    assert right.mean() > wrong.mean() + 0.2
