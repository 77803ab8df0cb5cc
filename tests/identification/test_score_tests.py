"""Score tests by hand."""

import numpy as np
import pytest
from scipy.stats import norm
from scipy.stats import t as student

from madoc.identification.score_tests import (
    Products,
    _together,
    deviate,
    family_score,
    imitators,
    joint_shift,
    parameter_shift,
    score,
    shared_deviate,
    variances_by_group,
)

EFFECT = np.array([[1.0, 1.0], [1.0, 1.0], [-1.0, -1.0], [-1.0, -1.0]])
NOISE = 0.1 * np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, 1.0], [-1.0, -1.0]])
ONES = np.ones((4, 2, 1))


def test_a_change_and_its_error():
    """y = -2 z + noise of ±0.1 that is orthogonal to z: the change is 2, and its error that of the noise."""
    found = score(Products.of(-2.0 * EFFECT + NOISE, ONES, EFFECT[..., None]), 2)
    assert found.change == pytest.approx(2.0)
    # Without window w the change moves by z_w · e_w / (z · z - z_w · z_w) = ±0.2 / (8 - 2); times 3/4 of 4 squares,
    # and times 4/3, as one of four degrees of freedom is the parameter's.
    assert found.error == pytest.approx(np.sqrt(4 / 3 * 3 / 4 * 4) * 0.2 / 6)
    assert found.explained == pytest.approx(32.0 / 32.08)
    assert found.freedom == pytest.approx(2.0)  # four windows that tell alike, less one and the parameter
    assert found.shifts == pytest.approx([0.0])  # the effect has no part along the parameter's


def test_a_column_that_parameters_imitate_is_none():
    products = Products.of(NOISE, ONES, 3.0 * ONES)
    assert score(products, 2) is None
    assert imitators(products, 2) == pytest.approx([-3.0])
    assert imitators(Products.of(NOISE, ONES, EFFECT[..., None]), 2) is None


def test_the_parameter_makes_room_for_the_term():
    """The effect is twice the parameter's and some more: with a change of -1 the parameter rises by 2."""
    effect = 2.0 * ONES + EFFECT[..., None]
    products = Products.of(EFFECT, ONES, effect)
    assert score(products, 2).shifts == pytest.approx([2.0])
    changes, shift, _ = joint_shift(products, [2])
    assert (changes[0], shift[0]) == (pytest.approx(-1.0), pytest.approx(2.0))


def test_two_terms_hide_each_other_and_are_found_together():
    """Of y = -(a + b) the parameter p explains all but what a and b do in opposite windows."""
    random = np.random.default_rng(0)
    a, b = np.zeros((40, 2, 1)), np.zeros((40, 2, 1))
    a[:20], b[20:] = 1.0, 1.0
    a, b = a * random.uniform(0.5, 1.5, (40, 1, 1)), b * random.uniform(0.5, 1.5, (40, 1, 1))
    p = (np.where(a + b > 0, 1.0, 0.0)).reshape(40, 2, 1)
    y = -(a + b)[..., 0] + 0.01 * random.standard_normal((40, 2))
    products = Products.of(y, p, np.concatenate([a, b], axis=-1))
    assert abs(score(products, 2).change - 1.0) > 0.2
    assert score(products, 2, [3]).change == pytest.approx(1.0, abs=0.02)


def test_a_window_with_a_magnified_effect_has_bounded_influence():
    effect = np.ones((9, 1, 1)) * np.array([1.0, -1.0] * 4 + [1000.0]).reshape(9, 1, 1)
    products = Products.of(np.zeros((9, 1)), np.ones((9, 1, 1)), effect)
    assert products.bounded([2])[8, 1, 1] == pytest.approx(9.0)
    assert products.bounded([1, 2])[8, 2, 2] == pytest.approx(9.0)
    np.testing.assert_array_equal(products.bounded([1]), products.each[:, :2, :2])


def test_the_step_to_the_minimum():
    step, covariance = parameter_shift(Products.of(0.5 + NOISE, ONES, np.zeros((4, 2, 0))))
    assert step == pytest.approx([-0.5])
    assert covariance[0, 0] == pytest.approx(3 / 4 * 4 * (0.2 / 6) ** 2)


def test_a_ratio_counts_less_with_few_degrees_of_freedom():
    """The quantile of 97.5 % of Student's t is 12.7 with one degree of freedom, and 1.96 with many."""
    assert deviate(12.706, 1.0) == pytest.approx(1.96, abs=1e-3)
    assert deviate(-12.706, 1.0) == pytest.approx(-1.96, abs=1e-3)
    assert deviate(1.96, 1e6) == pytest.approx(1.96, abs=1e-3)


def test_leaving_out_runs_shows_what_differs_between_them():
    """Runs of three windows each, whose values of p are ±1: windows of a run err together, so four runs count."""
    signs = np.repeat([1.0, -1.0, 1.0, -1.0], 3)
    ones = np.ones((12, 2, 1))
    products = Products.of(np.tile(signs[:, None], (1, 2)), ones, np.zeros((12, 2, 0)))
    by_run, freedom = variances_by_group(products, np.repeat(np.arange(4), 3))
    by_window, windows = variances_by_group(products, np.arange(12))
    # Without run g of four the mean moves by ±1 · 6 / (24 - 6), without one window of twelve by ±2 / 22.
    assert by_run == pytest.approx([3 / 4 * 4 * (1 / 3) ** 2])
    assert by_window == pytest.approx([11 / 12 * 12 * (1 / 11) ** 2])
    assert (freedom, windows) == (pytest.approx([3.0]), pytest.approx([11.0]))


def test_one_of_many_tests_is_as_significant_as_if_it_were_the_only_one():
    assert shared_deviate(norm.isf(1e-4), 50) == pytest.approx(norm.isf(5e-3))
    assert shared_deviate(0.0, 3) == -np.inf
    assert shared_deviate(2.0, 1) == pytest.approx(2.0)


def test_a_family_of_one_column_is_hotellings_test_by_hand():
    """Windows of scores 1, 2, 1, 2, ...: T² = n mean² / variance, here Student's t² with n - 1 degrees of freedom."""
    residuals = -np.tile([1.0, 2.0], 10)[:, None]
    products = Products.of(residuals, np.zeros((20, 1, 0)), np.ones((20, 1, 1)))
    together, found = _together(products, [1], ()), family_score(products, [1])
    t = np.sqrt(20) * 1.5 / np.sqrt(0.25 * 20 / 19)
    assert together.t == pytest.approx(norm.isf(student.sf(t, 19)))
    assert together.changes == pytest.approx([1.5])
    # Of the mean square 2.5 the mean explains 2.25, and by chance its variance of 5 / 19 / 20.
    assert together.explained == pytest.approx((2.25 - 0.25 / 19) / 2.5)
    assert found.t == pytest.approx(max(shared_deviate(each, 2) for each in (together.t, score(products, 1).t)))
    assert (found.leading, len(found.shifts)) == (0, 0)


def test_one_column_of_many_shows_by_itself():
    random = np.random.default_rng(0)
    columns = random.standard_normal((60, 8, 40))
    products = Products.of(-0.4 * columns[..., 7] + random.standard_normal((60, 8)), np.zeros((60, 8, 0)), columns)
    found, alone = family_score(products, range(1, 41)), score(products, 8)
    assert found.leading == 7
    assert found.t == pytest.approx(shared_deviate(alone.t, 80))
    assert np.flatnonzero(found.changes).tolist() == [7]


def planted(size, seed):
    """Windows in which five columns beside the parameter's are tried, and a mixture of two of them is missing."""
    random = np.random.default_rng(seed)
    columns, parameter = random.standard_normal((90, 8, 5)), random.standard_normal((90, 8, 1))
    columns[..., 3] += parameter[..., 0]  # so that the parameter makes up for a part of it
    missing = columns[..., 1] + columns[..., 3]
    loud = random.uniform(0.5, 2.0, (90, 1))
    return Products.of(-size * missing + loud * random.standard_normal((90, 8)), parameter, columns)


def test_a_family_finds_a_mixture_and_says_how_it_moves_the_parameter():
    found = family_score(planted(0.5, 0), range(2, 7))
    assert found.t > 6.0
    assert _together(planted(0.5, 0), range(2, 7), ()).changes == pytest.approx([0.0, 0.5, 0.0, 0.5, 0.0], abs=0.12)
    assert found.shifts == pytest.approx([-0.5], abs=0.15)
    assert 0.01 < found.errors[0] < 0.1
    assert found.leading in (1, 3)


def test_a_family_of_which_nothing_is_missing_is_as_significant_as_chance_says():
    of = [planted(0.0, seed) for seed in range(400)]
    significant = [_together(products, range(2, 7), ()).t > norm.isf(0.05 / 2) for products in of]
    assert np.mean(significant) == pytest.approx(0.05, abs=0.03)
    assert np.mean([family_score(products, range(2, 7)).t > norm.isf(0.05 / 2) for products in of]) < 0.06


def test_a_family_that_parameters_imitate_is_none():
    assert family_score(Products.of(NOISE, ONES, 3.0 * ONES), [2]) is None


def test_columns_put_together_have_the_products_of_their_sum():
    random = np.random.default_rng(0)
    residuals, parameter, columns = (random.standard_normal(shape) for shape in ((5, 3), (5, 3, 1), (5, 3, 2)))
    weights = np.array([[2.0], [-1.0]])
    combined = Products.of(residuals, parameter, columns).combined([1], [2, 3], weights)
    assert combined.each == pytest.approx(Products.of(residuals, parameter, columns @ weights).each)


def test_a_column_is_taken_away_from_the_residuals_of_products():
    residuals, by_value, first, second = np.random.default_rng(0).standard_normal((4, 3, 5))
    columns = by_value[..., None], np.stack([first, second], axis=-1)
    less = Products.of(residuals, *columns).less(2, 0.5)
    np.testing.assert_allclose(less.each, Products.of(residuals + 0.5 * first, *columns).each)
    assert less.count == 1
