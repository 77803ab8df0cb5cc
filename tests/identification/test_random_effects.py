import numpy as np
import pytest
from scipy import stats

from madoc.identification.random_effects import between, common, outliers


def test_equal_errors_by_hand():
    """Of 1, 2, 3, 4, 5 with error variance ½: variance 2.5 of the estimates, so τ² = 2.5 - 0.5; mean 3 ± t √(2.5/5)."""
    told = common(np.arange(1.0, 6.0), np.full(5, np.sqrt(0.5)))
    assert told.mean == pytest.approx(3.0)
    assert told.spread**2 == pytest.approx(2.0, rel=1e-5)
    half = stats.t.ppf(0.975, 4) * np.sqrt(0.5)
    assert told.interval == pytest.approx((3 - half, 3 + half), rel=1e-5)
    reach = stats.t.ppf(0.975, 3) * np.sqrt(2.0 + 0.5)
    assert told.range == pytest.approx((3 - reach, 3 + reach), rel=1e-5)
    assert told.homogeneity == pytest.approx(stats.chi2.sf(20.0, 4))  # Q = 10 / ½


def test_no_spread_where_the_errors_explain_all():
    told = common(np.array([1.0, 1.1, 0.9]), np.full(3, 1.0))
    assert told.spread == 0.0
    assert told.homogeneity > 0.9
    assert common(np.full(4, 2.0), np.full(4, 1e-12)).spread == 0.0


def test_two_robots_have_a_mean_but_no_range_for_a_third():
    told = common(np.array([1.0, 2.0]), np.array([0.1, 0.1]))
    assert told.mean == pytest.approx(1.5)
    assert told.range is None


def test_the_unit_does_not_matter():
    estimates, errors = np.array([1.0, 1.4, 2.1, 0.7]), np.array([0.1, 0.2, 0.1, 0.3])
    one, other = common(estimates, errors), common(1e-9 * estimates, 1e-9 * errors)
    assert other.spread == pytest.approx(1e-9 * one.spread, rel=1e-4)
    assert other.mean == pytest.approx(1e-9 * one.mean, rel=1e-6)


def test_planted_spread_comes_back_and_intervals_cover():
    random = np.random.default_rng(0)
    spreads, covered = [], []
    for _ in range(100):
        errors = random.uniform(0.05, 0.2, 12)
        estimates = 1.0 + 0.15 * random.standard_normal(12) + errors * random.standard_normal(12)
        told = common(estimates, errors)
        spreads.append(told.spread)
        covered.append(told.interval[0] < 1.0 < told.interval[1])
    assert np.mean(np.square(spreads)) == pytest.approx(0.15**2, rel=0.15)
    assert 0.9 <= np.mean(covered) <= 1.0


def test_two_outliers_do_not_hide_each_other_and_none_is_called_one_for_nothing():
    random = np.random.default_rng(1)
    errors = np.full(20, 0.05)
    alike = 1.0 + 0.02 * random.standard_normal(20) + errors * random.standard_normal(20)
    assert outliers(alike, errors) == {}
    odd = alike.copy()
    odd[[3, 11]] = (1.6, 1.7)
    found = outliers(odd, errors)
    assert set(found) == {3, 11}
    assert max(found.values()) < 0.05
    assert between(np.delete(odd, [3, 11]), errors[:18]) < 0.05**2
