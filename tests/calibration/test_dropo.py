"""DROPO's equations against numbers worked out by hand."""

import jax
import numpy as np
import pytest
from scipy import stats

from madoc.calibration.baselines.droid import trajectory_cost
from madoc.calibration.baselines.dropo.calibrator import DEVIATIONS, distribution_of
from madoc.calibration.baselines.dropo.likelihood import (
    entropy,
    moments,
    negative_log_likelihood,
    parameter_draws,
    truncated_noise,
)


def test_noise_is_cut_off_at_two_deviations_and_comes_in_mirrored_pairs():
    noise = truncated_noise(jax.random.key(0), 5000, 2)
    assert noise.shape == (10_000, 2)
    assert np.abs(noise).max() <= 2.0
    np.testing.assert_array_equal(noise[5000:], -noise[:5000])
    assert noise.std() == pytest.approx(stats.truncnorm(-2, 2).std(), abs=0.01)


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


def test_the_likelihood_is_that_of_a_normal_distribution():
    mean, covariance = np.array([0.3, -0.2]), np.array([[0.5, 0.2], [0.2, 0.4]])
    found = negative_log_likelihood(mean[None, None], covariance[None, None], 0.1)
    expected = -stats.multivariate_normal(mean, covariance + 0.1 * np.eye(2)).logpdf(np.zeros(2))
    assert found.item() == pytest.approx(expected)


def test_a_likelihood_by_hand():
    # One value 2 off, variance 3 + 1: (ln 2π + ln 4 + 4 / 4) / 2.
    found = negative_log_likelihood(np.array([[[2.0]]]), np.array([[[[3.0]]]]), 1.0)
    assert found.item() == pytest.approx((np.log(2 * np.pi) + np.log(4.0) + 1.0) / 2.0)


def test_rows_without_moments_have_no_likelihood():
    found = negative_log_likelihood(np.array([[[np.nan], [0.0]]]), np.array([[[[np.nan]], [[1.0]]]]), 0.0)
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
