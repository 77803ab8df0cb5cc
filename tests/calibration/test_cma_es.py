"""Distances of clouds whose order is unknown."""

import jax
import numpy as np
import pytest

from madoc.calibration.baselines.cma_es import (
    RIDGE,
    CosineFeatures,
    adjusted,
    cosine_features,
    discrepancies,
)


def test_features_by_hand():
    features = CosineFeatures(np.array([[1.0], [2.0]]), np.array([np.pi / 2]))
    assert features(np.array([[0.5, -0.25], [np.pi / 2, 0.0]])) == pytest.approx(np.array([[0.0], [-1.0]]), abs=1e-12)


def test_the_mean_of_many_rows_is_that_of_its_parts():
    features = cosine_features(jax.random.key(0), 2, 6)
    rows = np.random.default_rng(0).normal(size=(25_001, 2))
    np.testing.assert_allclose(features.mean(rows), features(rows).mean(0), atol=1e-12)


def test_random_features_are_those_of_gaussian_kernels():
    # Twice the mean product of cosines with random phases is the kernel, here the mean of three widths.
    features = cosine_features(jax.random.key(0), 2, 60_000)
    rows = np.array([[0.0, 0.0], [1.0, 0.5]])
    product = 2.0 * features(rows).prod(0).mean()
    widths = np.sqrt(2.0) * np.array([0.5, 1.0, 2.0])
    assert product == pytest.approx(np.exp(-1.25 / (2 * widths**2)).mean(), abs=0.01)


def test_a_discrepancy_by_hand():
    # Two rows, mean 1, variance 1 about it: 2 · (1 - 3)² / (1 + ridge).
    found = discrepancies(np.array([[[0.0], [2.0]]]), np.array([3.0]))
    assert found == pytest.approx([8.0 / (1.0 + RIDGE)])


def test_the_order_of_rows_does_not_matter():
    rng = np.random.default_rng(0)
    clouds, wanted = rng.normal(size=(2, 30, 4)), np.zeros(4)
    np.testing.assert_allclose(discrepancies(clouds[:, rng.permutation(30)], wanted), discrepancies(clouds, wanted))


def test_rows_that_failed_are_left_out_of_the_mean_and_bring_no_cloud_nearer():
    # Mean and variance are those of the two rows left, but three were simulated: 3 · (1 - 3)² / (1 + ridge).
    clouds = np.array([[[0.0], [2.0], [np.nan]], [[np.nan], [np.nan], [np.nan]]])
    found = discrepancies(clouds, np.array([3.0]))
    assert found[0] == pytest.approx(12.0 / (1.0 + RIDGE))
    assert np.isnan(found[1])


def test_all_failed_is_no_error():
    assert np.isnan(discrepancies(np.full((2, 3, 1), np.nan), np.zeros(1))).all()


def test_at_the_truth_the_distance_is_what_chance_leaves():
    rows = np.random.default_rng(0).normal(size=(50, 500, 20))
    assert discrepancies(rows, np.zeros(20)).mean() / 20 == pytest.approx(1.0, abs=0.15)


def test_what_a_draw_differs_from_the_log_by_is_taken_off():
    # Features 1 + 2 z of rows whose z should be 0 on average, but is 2: their mean is 5 and becomes 1.
    drawn = np.array([[1.0], [2.0], [3.0]])
    found = adjusted((1.0 + 2.0 * drawn)[None], drawn)
    assert found == pytest.approx(np.ones((1, 3, 1)), abs=1e-4)


def test_rows_that_failed_stay_so_and_give_no_slope():
    drawn = np.array([[1.0], [2.0], [3.0]])
    features = np.stack([1.0 + 2.0 * drawn, np.array([[7.0], [7.0], [np.nan]])])
    found = adjusted(features, drawn)
    assert found[0] == pytest.approx(np.ones((3, 1)), abs=1e-4)
    assert found[1, :2] == pytest.approx(np.full((2, 1), 7.0), abs=1e-4)
    assert np.isnan(found[1, 2])
    assert adjusted(np.full((1, 2, 1), np.nan), drawn[:2]).shape == (1, 2, 1)
