"""OTED by hand: the bandit's gradient, its reward, and the divergence it climbs down."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from affine import affine
from madoc.calibration.baselines.oted import (
    REWARD_BOUND,
    Distribution,
    advantages,
    antithetic_noise,
    comparable_starts,
    first_lives,
    mean_rewards,
    natural_step,
    visits,
)
from madoc.data.dataset import close_episodes
from madoc.learning.dynamics_reward import discriminator_loss
from robots import SPRING_TRUTH, recorded, spring


def test_every_draw_has_its_mirror_image():
    noise = antithetic_noise(jax.random.key(0), 3, 2)
    np.testing.assert_array_equal(noise[:3], -noise[3:])


def test_a_natural_step_by_hand():
    before = Distribution(np.array([1.0]), np.log([0.5]))
    noise, advantage = np.array([[2.0], [-2.0]]), np.array([1.0, -0.5])
    after = natural_step(before, noise, advantage, mean_rate=0.1, std_rate=0.2)
    # E[A ε] = (2 + 1) / 2, E[A (ε² - 1)] = (3 - 1.5) / 2
    assert after.mean == pytest.approx([1.0 + 0.1 * 0.5 * 1.5])
    assert after.log_std == pytest.approx(np.log([0.5]) + 0.2 * 0.5 * 0.75)


def test_the_gradient_is_that_of_the_expected_reward():
    # Reward -(x - 3)² under N(μ, σ²) is -(μ - 3)² - σ²: natural slopes are σ² · 2 (3 - μ) and ½ · (-2 σ²).
    before = Distribution(np.array([1.0]), np.log([0.5]))
    noise = np.asarray(antithetic_noise(jax.random.key(1), 200_000, 1), np.float64)
    reward = -((1.0 + 0.5 * noise[:, 0] - 3.0) ** 2)
    after = natural_step(before, noise, reward, mean_rate=1.0, std_rate=1.0)
    assert after.mean - before.mean == pytest.approx([0.25 * 4.0], rel=0.02)
    assert after.log_std - before.log_std == pytest.approx([-0.25], rel=0.05)


def test_advantages_have_no_units():
    rewards = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(advantages(rewards), advantages(1000.0 * rewards + 5.0), rtol=1e-6)
    np.testing.assert_array_equal(advantages(np.ones(3)), 0.0)


def test_rewards_are_means_over_what_survived():
    ratio = np.array([[[1.0, 3.0], [50.0, 7.0], [0.0, 0.0]]])
    valid = np.array([[[True, True], [True, False], [False, False]]])
    np.testing.assert_array_equal(mean_rewards(ratio, valid), [2.0, REWARD_BOUND, 2.0])
    np.testing.assert_array_equal(mean_rewards(ratio, np.zeros_like(valid)), -REWARD_BOUND)


def test_the_best_discriminator_says_the_log_ratio_of_densities():
    # Pair 1 is three times as frequent in the data, pair 0 in the simulator: the best logits are ± log 3.
    logged, simulated = jnp.array([[1.0]] * 3 + [[0.0]]), jnp.array([[1.0]] + [[0.0]] * 3)
    best, *others = (
        float(discriminator_loss(network(logged)[:, 0], network(simulated)[:, 0]))
        for network in (affine([[2.0 * logit]], [-logit]) for logit in np.log([3.0, 2.5, 3.5]))
    )
    assert best < min(others)


def two_episodes(falls):
    """Rows 0 to 3 and 4 to 6; whether the second ends in a fall."""
    log = recorded(spring(), SPRING_TRUTH, 7, jax.random.key(0))
    starts = np.array([0, 4])
    rows = replace(log.transitions, terminated=np.arange(7) == (6 if falls else -1), truncated=np.zeros(7, dtype=bool))
    return replace(log, transitions=close_episodes(rows, starts), episode_starts=starts)


def test_rollouts_start_where_the_record_goes_on_as_long_or_to_a_fall():
    rows = np.arange(7)
    np.testing.assert_array_equal(comparable_starts(two_episodes(False), rows, 3), [0, 1, 4])
    np.testing.assert_array_equal(comparable_starts(two_episodes(True), rows, 3), [0, 1, 4, 5, 6])


def test_rows_are_counted_as_often_as_they_are_reached():
    # From 0: rows 1 and 2; from 1: rows 2 and 3; from 4: rows 5 and 6.
    np.testing.assert_array_equal(visits(two_episodes(False), np.array([0, 1, 4]), 3), [0, 1, 2, 1, 0, 1, 1])
    np.testing.assert_array_equal(visits(two_episodes(True), np.array([4, 5, 6]), 3), [0, 0, 0, 0, 0, 1, 2])


def test_a_row_that_began_anew_is_not_compared():
    log = recorded(spring(), SPRING_TRUTH, 4, jax.random.key(0)).transitions
    seen = replace(log, terminated=np.array([False, True, False, False]), truncated=np.zeros(4, dtype=bool))
    np.testing.assert_array_equal(first_lives(seen, np.ones(4, dtype=bool)), [True, True, False, False])
    broken = replace(seen, terminated=np.zeros(4, dtype=bool))
    np.testing.assert_array_equal(first_lives(broken, np.arange(4) != 1), [True, False, False, False])
