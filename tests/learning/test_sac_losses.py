import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from affine import affine
from madoc.learning import sac_losses
from madoc.learning.sac_losses import TwinCritic
from madoc.learning.tanh_gaussian import TanhGaussianPolicy


def critic_of(first, second):
    """Twins of chosen affine maps of (s, a)."""
    made = TwinCritic(len(first[0][0]) - 1, 1, (), key=jax.random.key(0))
    return eqx.tree_at(lambda twins: (twins.first, twins.second), made, (affine(*first), affine(*second)))


def policy_of(weight, bias):
    """Mean and log std as chosen affine maps of s."""
    made = TanhGaussianPolicy(len(weight[0]), len(weight) // 2, (), key=jax.random.key(0))
    return eqx.tree_at(lambda policy: policy.network, made, affine(weight, bias))


TWINS = critic_of(([[1, 2]], [0.5]), ([[-1, 1]], [3]))


def test_twins_by_hand(compiled):
    first, second = compiled(TWINS)(jnp.array([[1.0], [0.0]]), jnp.array([[0.5], [-1.0]]))
    np.testing.assert_allclose(first, [2.5, -1.5])  # 1 + 2·0.5 + 0.5, 0 - 2 + 0.5
    np.testing.assert_allclose(second, [2.5, 2.0])  # -1 + 0.5 + 3, 0 - 1 + 3


def test_twins_start_different():
    first, second = TwinCritic(1, 1, (8,), key=jax.random.key(0))(jnp.ones((3, 1)), jnp.ones((3, 1)))
    assert not np.allclose(first, second)


def test_soft_target_by_hand(compiled):
    # going on:  2 + 0.9 (10 - 0.5·(-4)) = 2 + 0.9·12 = 12.8
    # terminated: 2
    target = compiled(sac_losses.soft_target)(
        jnp.array([2.0, 2.0]),
        jnp.array([0.0, 1.0]),
        jnp.array([10.0, 10.0]),
        jnp.array([-4.0, -4.0]),
        temperature=jnp.asarray(0.5),
        discount=0.9,
    )
    np.testing.assert_allclose(target, [12.8, 2.0], rtol=1e-6)


def test_the_least_value_by_hand(compiled):
    # a least reward of -2 at every step: -2 / (1 - 0.9); where no reward is below 0, an end is the least: 0
    least = compiled(lambda rewards: sac_losses.least_value(rewards, 0.9))
    assert least(jnp.array([1.0, -2.0, 3.0])) == pytest.approx(-20.0, rel=1e-5)
    assert least(jnp.array([1.0, 3.0])) == 0.0


def test_critic_loss_by_hand(compiled):
    # values (2.5, -1.5) and (2.5, 2.0) as above, targets (1.5, 0.5):
    # ½ (mean(1², 2²) + mean(1², 1.5²)) = ½ (2.5 + 1.625) = 2.0625
    loss = compiled(sac_losses.critic_loss)(
        TWINS, jnp.array([[1.0], [0.0]]), jnp.array([[0.5], [-1.0]]), jnp.array([1.5, 0.5])
    )
    assert loss == pytest.approx(2.0625)


def test_actor_loss_is_temperature_times_log_density_minus_the_smaller_value(compiled):
    policy = policy_of([[0.5], [0]], [0.25, np.log(0.4)])
    observation, key = jnp.array([[1.0], [-1.0], [2.0]]), jax.random.key(7)
    loss, (value, density) = compiled(sac_losses.actor_loss)(
        policy, TWINS, observation, temperature=jnp.asarray(0.2), noise=key
    )
    mean = 0.5 * np.array([1.0, -1.0, 2.0]) + 0.25
    raw = mean + 0.4 * np.asarray(jax.random.normal(key, (3, 1)), np.float64)[:, 0]
    action = np.tanh(raw)
    expected_density = stats.norm.logpdf(raw, mean, 0.4) - np.log1p(-(action**2))
    state = np.array([1.0, -1.0, 2.0])
    expected_value = np.minimum(state + 2 * action + 0.5, -state + action + 3)
    np.testing.assert_allclose(density, expected_density, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(value, expected_value, rtol=1e-5)
    assert loss == pytest.approx((0.2 * expected_density - expected_value).mean(), rel=1e-5)


def test_temperature_loss_by_hand(compiled):
    # log π + target entropy = (-1 - 2, 6 - 2), mean 0.5; times -log α = -0.5 is -0.25
    loss = compiled(sac_losses.temperature_loss)(jnp.asarray(0.5), jnp.array([-1.0, 6.0]), -2.0)
    assert loss == pytest.approx(-0.25)


def test_temperature_rises_where_the_policy_is_too_sure():
    def slope(density, entropy):
        return jax.grad(sac_losses.temperature_loss)(jnp.asarray(0.5), jnp.asarray(density), entropy)

    # the gradient is -(mean log π + target entropy); descent goes against it
    assert slope([3.0, 5.0], -1.0) == pytest.approx(-3.0)  # entropy -4 < target -1: α rises
    assert slope([-1.0, -1.0], -1.0) == pytest.approx(2.0)  # entropy 1 > target -1: α falls
    assert slope([1.0, 1.0], -1.0) == pytest.approx(0.0)


def test_temperature_loss_moves_nothing_but_the_temperature():
    density = jax.grad(lambda density: sac_losses.temperature_loss(jnp.asarray(0.5), density, -1.0))
    np.testing.assert_array_equal(density(jnp.array([1.0, 2.0])), [0.0, 0.0])


def test_cloning_error_by_hand(compiled):
    # means 0.5 and arctanh 0.6, so actions tanh 0.5 = 0.462117 and 0.6, against 0 and 0.1:
    # mean(0.213552, 0.25) = 0.231776
    policy = policy_of([[0.5], [np.arctanh(0.6)], [0], [0]], [0, 0, -1, -1])
    error = compiled(sac_losses.cloning_error)(policy, jnp.array([[1.0]]), jnp.array([[0.0, 0.1]]))
    assert error == pytest.approx(0.231776, rel=1e-5)
