import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from affine import affine
from madoc.learning.dynamics_ratio import Discriminators, log_dynamics_ratio
from madoc.learning.sac_losses import TwinCritic
from madoc.policies.h2o import dynamics_gap, dynamics_ratio, gap_weighted_value, h2o_loss


def column(numbers):
    return jnp.asarray(numbers, jnp.float32)[:, None]


def test_ratio_by_hand(compiled):
    # e^-1; e^2 is cut to 1; e^-20 to 1e-5
    ratio = compiled(dynamics_ratio)(jnp.array([-1.0, 2.0, -20.0]))
    np.testing.assert_allclose(ratio, [0.367879, 1.0, 1e-5], rtol=1e-5)


def test_gap_is_minus_the_mean_log_ratio_within_bounds(compiled):
    made = Discriminators(1, 1, (), key=jax.random.key(0), bound=2.0, pair_bound=2.0, dropout=0.0)
    # f_sas = 2 tanh(0.3 s' (1, -1)): log ratio 4 tanh(0.3 s')
    made = eqx.tree_at(lambda parts: parts.triple, made, affine([[0, 0, 0.3], [0, 0, -0.3]], [0, 0]))
    pair, following = jnp.zeros((2, 2)), column([-1.0, 2.0])
    exact = compiled(lambda key: dynamics_gap(made, pair, following, spread=0.0, samples=3, key=key))(jax.random.key(0))
    # at s' = -1 4 tanh 0.3 = 1.165250; at s' = 2 the simulator is more likely real than not: the least gap
    np.testing.assert_allclose(exact, [1.165250, 1e-30], rtol=1e-4)
    np.testing.assert_allclose(log_dynamics_ratio(made, pair, following)[0], -1.165250, rtol=1e-5)
    key = jax.random.key(3)
    blurred = dynamics_gap(made, pair, following, spread=0.5, samples=10, key=key)
    draws = -1.0 + 0.5 * np.asarray(jax.random.normal(key, (10, 2, 1)))[:, 0, 0]
    assert blurred[0] == pytest.approx(-4 * np.tanh(0.3 * draws).mean(), rel=1e-4)


def test_gap_weighted_value_by_hand(compiled):
    # ω = (1/4, 3/4): log(e/4 + 3e²/4) = log(0.679570 + 5.541792) = 1.827989
    assert compiled(gap_weighted_value)(jnp.array([1.0, 2.0]), jnp.array([0.5, 1.5])) == pytest.approx(
        1.827989, rel=1e-5
    )


def test_rows_of_larger_gap_are_pushed_down_more():
    slope = jax.grad(gap_weighted_value)(jnp.array([1.0, 1.0]), jnp.array([0.5, 1.5]))
    np.testing.assert_allclose(slope, [0.25, 0.75], rtol=1e-6)


def test_loss_by_hand(compiled):
    # Q = s + 2a + 0.5 and -s + a + 3
    # logged (1, 0.5): 2.5, 2.5, target 2 -> 0.25 + 0.25; simulated (0, -1): -1.5, 2, target 0.5 -> 4 + 2.25, times 0.2
    # regulariser of one row: ω = 1, so Q simulated - Q logged: -4 and -0.5
    made = TwinCritic(1, 1, (), key=jax.random.key(0))
    nets = affine([[1, 2]], [0.5]), affine([[-1, 1]], [3])
    critic = eqx.tree_at(lambda parts: (parts.first, parts.second), made, nets)
    logged = column([1.0]), column([0.5]), jnp.array([2.0])
    simulated = column([0.0]), column([-1.0]), jnp.array([0.5])
    loss, regulariser = compiled(
        lambda critic: h2o_loss(critic, logged, simulated, ratio=jnp.array([0.2]), gap=jnp.array([3.0]), weight=0.01)
    )(critic)
    assert regulariser == pytest.approx(-4.5)
    assert loss == pytest.approx(0.5 + 0.2 * 6.25 - 0.045, rel=1e-5)
