"""The regression of s' on (s, a), and the noise that it tells, on linear systems whose numbers are known."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from affine import affine
from madoc.learning.expectation import (
    LEAST_SPREAD,
    NORMAL_MAD,
    expected,
    fresh_expectation,
    learn_expectation,
    noise_of_log,
    regression_loss,
)

A = np.array([[0.9, 0.2], [-0.3, 0.7]])
B = np.array([[0.0], [0.5]])
PAIR_SCALE, NEXT_SCALE = np.array([2.0, 0.5, 1.0]), np.array([0.4, 0.1])
ROWS, EPISODE = 20_000, 500


def log_of(noise, seed=0):
    """Features of (s, a) and of s' - s of x' = A x + B a read with noise, and whether each row is the next of one."""
    random = np.random.default_rng(seed)
    action = random.normal(size=(ROWS // EPISODE, EPISODE, 1))
    state = np.zeros((ROWS // EPISODE, EPISODE + 1, 2))
    state[:, 0] = random.normal(size=(ROWS // EPISODE, 2))
    for step in range(EPISODE):
        state[:, step + 1] = state[:, step] @ A.T + action[:, step] @ B.T
    seen = state + noise * random.normal(size=state.shape)
    window = np.concatenate([seen[:, :-1], action], axis=-1) / PAIR_SCALE
    following = (seen[:, 1:] - seen[:, :-1]) / NEXT_SCALE
    consecutive = np.tile(np.arange(EPISODE) > 0, ROWS // EPISODE)
    flat = (jnp.asarray(part.reshape(ROWS, -1), jnp.float32) for part in (window, following))
    return tuple(flat), consecutive


def exact(logged):
    """A regression of one linear layer, with the weights of the system itself."""
    weight = np.concatenate([A - np.eye(2), B], axis=1) * PAIR_SCALE / NEXT_SCALE[:, None]
    return replace(fresh_expectation(logged, (), updates=1, key=jax.random.key(0)), network=affine(weight, np.zeros(2)))


def noise_by_system(noise, seed=0):
    logged, consecutive = log_of(np.asarray(noise), seed)
    return noise_of_log(exact(logged), logged, consecutive, NEXT_SCALE / PAIR_SCALE[:2]) * NEXT_SCALE


def test_regression_loss_by_hand(compiled):
    # 0.05 is below the turn at 0.1: ½ · 0.05² / 0.1 = 0.0125; beyond, -0.3 gives 0.3 - 0.05; the mean of both
    loss = compiled(regression_loss)(jnp.array([[0.05, -0.3]]))
    assert loss == pytest.approx((0.0125 + 0.25) / 2)


@pytest.mark.parametrize("noise", [(0.02, 0.2), (0.3, 0.3)])
def test_noise_is_told_by_the_residuals_of_consecutive_rows(noise):
    # Residuals are e' - A e exactly, with E[r' rᵀ] = -A Σ; 20 000 rows tell a deviation to about 2 %.
    np.testing.assert_allclose(noise_by_system(noise), noise, rtol=0.1)


def test_a_channel_that_is_exact_is_told_from_one_that_is_not():
    first, second = noise_by_system((0.0, 0.2))
    assert first == 0.0
    assert second == pytest.approx(0.2, rel=0.1)


def test_without_noise_none_is_told_nor_where_no_row_follows_another():
    assert noise_by_system((0.0, 0.0)).tolist() == [0.0, 0.0]
    logged, consecutive = log_of(0.3)
    assert noise_of_log(exact(logged), logged, np.zeros_like(consecutive), np.ones(2)).tolist() == [0.0, 0.0]


def trained(logged, seed=0, epochs=3):
    made = fresh_expectation(logged, (), updates=epochs * 200, key=jax.random.key(seed))
    for key in jax.random.split(jax.random.key(seed), epochs):
        before, (made, loss) = made, learn_expectation(made, logged, key, batch=64, updates=200, epochs=epochs)
    return before, made, loss


def test_what_is_left_is_in_units_of_its_spread_over_logged_rows():
    logged, _ = log_of(0.0)
    window, following = logged
    scattered = following + 0.3 * jax.random.normal(jax.random.key(1), following.shape)
    before, made, _ = trained((window, scattered))
    assert before.epochs == 2 and (before.spread == 1.0).all() and not before.logged.any()
    left = np.asarray(scattered - expected(made.network, window))
    np.testing.assert_allclose(made.spread, NORMAL_MAD * np.median(np.abs(left), axis=0), rtol=1e-5)
    np.testing.assert_allclose(made.logged, left / made.spread, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(made.left(np.asarray(window), np.asarray(scattered)), made.logged, atol=1e-5)
    assert (made.spread > 0.29).all()


def test_what_is_expected_exactly_has_the_least_spread():
    logged = jax.random.normal(jax.random.key(0), (100, 3)), jnp.zeros((100, 2))
    made = fresh_expectation(logged, (), updates=1, key=jax.random.key(0))
    made = replace(made, network=jax.tree.map(jnp.zeros_like, made.network))
    made, _ = learn_expectation(made, logged, jax.random.key(0), batch=8, updates=1, epochs=1)
    np.testing.assert_array_equal(made.spread, [LEAST_SPREAD, LEAST_SPREAD])


def test_the_same_seed_has_the_same_bits():
    logged, _ = log_of(0.1)
    (_, first, loss), (_, again, same) = trained(logged, epochs=1), trained(logged, epochs=1)
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert loss == same
    assert trained(logged, seed=1, epochs=1)[2] != loss
