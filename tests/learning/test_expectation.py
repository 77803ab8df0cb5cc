"""The regression of s' on (s, a), and the noise that it tells, on linear systems whose numbers are known."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from affine import affine
from madoc.data import Dataset, Disturbance
from madoc.learning.expectation import (
    LEAST_SPREAD,
    NORMAL_MAD,
    derivatives_by_readings,
    expected,
    fresh_expectation,
    learn_expectation,
    noise_of_log,
    regression_loss,
)
from madoc.learning.features import LoggedFeatures, windows_ending
from madoc.types import Transitions

A = np.array([[0.9, 0.2], [-0.3, 0.7]])
B = np.array([[0.0], [0.5]])
ROWS, EPISODE = 20_000, 500


def log_of(noise, seed=0):
    """A log of x' = A x + B a, read with noise."""
    random = np.random.default_rng(seed)
    action = random.normal(size=(ROWS // EPISODE, EPISODE, 1))
    state = np.zeros((ROWS // EPISODE, EPISODE + 1, 2))
    state[:, 0] = random.normal(size=(ROWS // EPISODE, 2))
    for step in range(EPISODE):
        state[:, step + 1] = state[:, step] @ A.T + action[:, step] @ B.T
    seen = state + noise * random.normal(size=state.shape)
    zeros = np.zeros(ROWS)
    before, action, after = (part.reshape(ROWS, -1) for part in (seen[:, :-1], action, seen[:, 1:]))
    rows = Transitions(before, action, zeros, after, zeros.astype(bool), zeros.astype(bool))
    return Dataset(rows, np.arange(0, ROWS, EPISODE), "linear", "unknown", "a linear system")


def exact(log):
    """A regression of one linear layer, with the weights of the system itself."""
    scaling, logged = LoggedFeatures(log).windows("standardised", 1)
    row = scaling.scaling
    rate = np.concatenate([A - np.eye(2), B], axis=1)
    network = affine(rate * row.pair_scale / row.next_scale[:, None], rate @ row.pair_offset / row.next_scale)
    return replace(fresh_expectation(logged, (), updates=1, key=jax.random.key(0)), network=network)


def noise_by_system(noise, seed=0):
    log = log_of(np.asarray(noise), seed)
    return noise_of_log(log, LoggedFeatures(log), 1, exact(log))


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
    assert first < 0.02
    assert second == pytest.approx(0.2, rel=0.1)


def test_without_noise_none_is_told_nor_where_no_row_follows_another():
    np.testing.assert_allclose(noise_by_system((0.0, 0.0)), 0.0, atol=1e-6)
    noisy = log_of(0.3)
    for unordered in (
        replace(noisy, episode_starts=np.arange(ROWS)),
        replace(noisy, disturbance=Disturbance(shuffled="next_observations")),
    ):
        assert noise_of_log(unordered, LoggedFeatures(unordered), 1, exact(noisy)).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("length", [1, 3])
def test_a_reading_enters_the_residuals_as_derived(length):
    # One reading of a log that stands still is raised by 1: residuals of an affine regression change by H_k exactly.
    random = np.random.default_rng(0)
    log = log_of(0.1)
    scaling, _ = LoggedFeatures(log).windows("standardised", length)
    weight = random.normal(size=(2, scaling.sizes[0]))
    network = affine(weight, np.zeros(2))
    slopes = np.broadcast_to(weight, (1, *weight.shape))
    by_reading = derivatives_by_readings(scaling, slopes)[:, 0]

    def residuals(rows):
        window, following = scaling.features(windows_ending(rows, np.arange(length - 1, 20), length))
        return np.asarray(following - np.asarray(expected(network, window)), np.float64)

    rows = log.transitions.take(np.arange(20))
    raised = np.array(rows.observation), np.array(rows.next_observation)
    raised[0][10, 1] += 1.0
    raised[1][9, 1] += 1.0
    moved = residuals(replace(rows, observation=raised[0], next_observation=raised[1])) - residuals(rows)
    for lag, row in enumerate(range(9, 11 + length)):  # the window that ends in row 9 has the reading as its s'
        np.testing.assert_allclose(moved[row - (length - 1)], by_reading[lag, :, 1], atol=1e-4)


def trained(logged, seed=0, epochs=3):
    made = fresh_expectation(logged, (), updates=epochs * 200, key=jax.random.key(seed))
    for key in jax.random.split(jax.random.key(seed), epochs):
        before, (made, loss) = made, learn_expectation(made, logged, key, batch=64, updates=200, epochs=epochs)
    return before, made, loss


def test_what_is_left_is_in_units_of_its_spread_over_logged_rows():
    window, following = LoggedFeatures(log_of(0.0)).windows("standardised", 1)[1]
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
    logged = LoggedFeatures(log_of(0.1)).windows("standardised", 1)[1]
    (_, first, loss), (_, again, same) = trained(logged, epochs=1), trained(logged, epochs=1)
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert loss == same
    assert trained(logged, seed=1, epochs=1)[2] != loss
