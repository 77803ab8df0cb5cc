"""DROPO's equations against numbers worked out by hand."""

import jax
import numpy as np
import pytest
from scipy import stats

from madoc.calibration.baselines.droid import trajectory_cost
from madoc.calibration.baselines.dropo import (
    DEVIATIONS,
    distribution_of,
    entropy,
    moments,
    negative_log_likelihood,
    parameter_draws,
    residual_variance,
    shrunk,
    truncated_noise,
)


def test_noise_is_cut_off_at_two_deviations_and_independent():
    noise = truncated_noise(jax.random.key(0), 10_000, 2)
    assert noise.shape == (10_000, 2)
    assert np.abs(noise).max() <= 2.0
    assert noise.std() == pytest.approx(stats.truncnorm(-2, 2).std(), abs=0.01)
    assert np.corrcoef(noise[:5000].ravel(), noise[5000:].ravel())[0, 1] == pytest.approx(0.0, abs=0.03)


def test_draws_stand_about_the_mean_and_stay_in_the_box():
    draws = parameter_draws(np.array([[0.5, -0.9]]), np.array([[0.1, 0.2]]), np.array([[1.0, 1.0], [-1.0, -1.0]]))
    np.testing.assert_allclose(draws, [[[0.6, -0.7], [0.4, -1.0]]])


def test_moments_by_hand():
    residuals = np.array([[1.0, 0.0], [3.0, 4.0]])[None, :, None]  # one candidate, two draws, one row
    mean, covariance = moments(residuals)
    np.testing.assert_allclose(mean, [[[2.0, 2.0]]])
    np.testing.assert_allclose(covariance, [[[[2.0, 4.0], [4.0, 8.0]]]])


def test_failed_draws_are_left_out_of_the_moments():
    residuals = np.array([[1.0], [3.0], [np.nan]])[None, :, None]
    mean, covariance = moments(residuals)
    assert mean.item() == 2.0
    assert covariance.item() == 2.0
    mean, _ = moments(residuals[:, 1:])
    assert np.isnan(mean).all()


def test_shrinking_by_hand():
    # Two values, three draws, correlation 0.8: tr R² = 2 + 2 · 0.64 = 3.28, ρ = 4 / ((3 + 1 - 1) · 1.28) > 1.
    covariance = np.array([[4.0, 1.6], [1.6, 1.0]])[None, None]
    np.testing.assert_allclose(shrunk(covariance, np.array([[3]])), [[[[4.0, 0.0], [0.0, 1.0]]]])
    # With 100 draws ρ = 4 / (100 · 1.28) = 1 / 32.
    np.testing.assert_allclose(shrunk(covariance, np.array([[100]]))[0, 0, 0, 1], 1.6 * 31 / 32)


def test_a_covariance_of_few_draws_has_full_rank():
    residuals = np.random.default_rng(0).normal(size=(1, 6, 1, 11)) * np.logspace(-3, 1, 11)
    covariance = moments(residuals)[1]
    assert np.linalg.matrix_rank(covariance[0, 0]) == 5
    whole = shrunk(covariance, np.array([[6]]))[0, 0]
    scale = np.sqrt(np.diag(covariance[0, 0]))
    assert np.linalg.eigvalsh(whole / scale / scale[:, None]).min() > 0.1
    np.testing.assert_allclose(np.diag(whole), scale**2)
    assert not shrunk(np.zeros((1, 1, 2, 2)), np.array([[6]])).any()


def test_a_residual_has_the_noise_of_two_readings():
    variance = residual_variance(np.array([0.0, 0.3]), np.array([1.0, 3.0]), 1e-4)
    np.testing.assert_allclose(variance, [1e-4, 1e-4 + 2 * 0.01])


def test_the_likelihood_is_that_of_a_normal_distribution():
    mean, covariance = np.array([0.3, -0.2]), np.array([[0.5, 0.2], [0.2, 0.4]])
    found = negative_log_likelihood(mean[None, None], covariance[None, None], np.array([0.1, 0.3]))
    expected = -stats.multivariate_normal(mean, covariance + np.diag([0.1, 0.3])).logpdf(np.zeros(2))
    assert found.item() == pytest.approx(expected)


def test_a_likelihood_by_hand():
    # One value 2 off, variance 3 + 1: (ln 2π + ln 4 + 4 / 4) / 2.
    found = negative_log_likelihood(np.array([[[2.0]]]), np.array([[[[3.0]]]]), np.ones(1))
    assert found.item() == pytest.approx((np.log(2 * np.pi) + np.log(4.0) + 1.0) / 2.0)


def test_rows_without_moments_have_no_likelihood():
    found = negative_log_likelihood(np.array([[[np.nan], [0.0]]]), np.array([[[[np.nan]], [[1.0]]]]), np.zeros(1))
    assert np.isnan(found[0, 0])
    assert found[0, 1] == pytest.approx(0.5 * np.log(2 * np.pi))


def test_the_entropy_of_a_normal_distribution():
    assert entropy(np.array([[0.5, 2.0]])) == pytest.approx(stats.norm(0, 0.5).entropy() + stats.norm(0, 2.0).entropy())


def test_a_candidate_is_a_mean_and_a_log_deviation():
    mean, std = distribution_of(np.array([0.3, 0.1, -1.0, 1.0]))
    assert mean == pytest.approx([0.3, 0.1])
    assert std == pytest.approx(DEVIATIONS)
    assert distribution_of(np.zeros(2))[1] == pytest.approx([np.sqrt(DEVIATIONS[0] * DEVIATIONS[1])])


def test_droids_cost_weighs_both_distances():
    assert trajectory_cost(np.array([[1.0, -3.0]]), absolute=2.0, squared=0.5) == pytest.approx([2.0 * 2.0 + 0.5 * 5.0])
    assert np.isnan(trajectory_cost(np.array([[1.0, np.nan]]), absolute=1.0, squared=1.0)).all()
