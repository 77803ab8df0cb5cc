"""Products of two ensembles, each an instrument for the other, worked by hand."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from known_errors import known
from madoc.calibration.least_squares import instruments
from madoc.calibration.least_squares.instruments import Side, agreed, products_of, shares_of


@dataclass(frozen=True)
class Given(Side):
    """An ensemble whose errors and slopes are given."""

    by_hand: tuple[np.ndarray, np.ndarray]

    def errors(self):
        return self.by_hand[0]

    def off_line(self):
        return np.zeros_like(self.by_hand[0])

    def slopes(self):
        return self.by_hand[1]


def given(errors, slopes):
    nothing, nowhere = known(np.zeros((1, len(errors), 1, 1))), np.zeros(slopes.shape[-1])
    return Given(nothing.members, nothing, nothing, np.diag(nowhere), nowhere, None, (errors, slopes))


def test_chance_biases_no_product_of_two_ensembles():
    """Slopes of 1 with chance of variance 4: squares are 5, products 1; the gradient is that of the errors alone."""
    random, windows = np.random.default_rng(0), 4000
    errors = 0.3 + 0.1 * random.standard_normal((windows, 1))

    def side():
        chance = 2.0 * random.standard_normal((windows, 1, 1))
        return given(errors + 0.1 * chance[..., 0], 1.0 + chance)

    gradients, products, squares = products_of(side(), side(), np.ones(windows, bool), "linear")
    assert products.mean() == pytest.approx(1.0, abs=0.15)
    assert squares.mean() == pytest.approx(5.0, rel=0.1)
    assert gradients.mean() == pytest.approx(0.3, abs=0.05)  # with its own slopes an ensemble's would be 0.7
    np.testing.assert_allclose(agreed(np.array([[-1.0]]), np.array([[4.0]])), [[4.0 * instruments.AGREEING]])


def test_what_both_ensembles_agree_on_is_kept_along_a_weak_direction_too():
    """Two parameters that act alike but for a thousandth, and a third of which there is chance alone."""
    alike = np.array([[1.0, 1.0, 0.0], [1.0, 1.000001, 0.0], [0.0, 0.0, -0.5]])
    squares = alike + np.diag([0.0, 0.0, 2.5])
    expected = alike.copy()
    expected[2, 2] = 2.0 * instruments.AGREEING
    np.testing.assert_allclose(agreed(alike, squares), expected, atol=1e-9)


def test_a_window_of_chance_alone_does_not_decide():
    """Of thirty windows one has slopes a thousand times as large as the others'."""
    slopes = np.random.default_rng(0).standard_normal((30, 8, 2))
    slopes[0] *= 1000.0
    side = given(np.ones((30, 8)), slopes)
    gradients, products, squares = products_of(side, side, np.ones(30, bool), "linear")
    shares = shares_of(squares)
    np.testing.assert_allclose(shares.sum(0), np.eye(2), atol=1e-6)
    np.testing.assert_allclose(products, squares)  # one ensemble agrees with itself
    told = np.trace(shares, axis1=1, axis2=2) / 2.0
    assert told[0] == told.max() <= 1.05 * instruments.LARGEST_SHARE
    less = gradients[0] / slopes[0].sum(0)
    assert less[0] == pytest.approx(less[1]) and less[0] < 1e-4
    np.testing.assert_allclose(gradients[1:], slopes[1:].sum(1))


@pytest.mark.parametrize("loss", ["linear", "cauchy"])
def test_the_gradient_at_the_truth_is_none_though_chance_is_shared(loss):
    """Errors are noise and an ensemble's chance, which is also in its own slopes, a tenth of a range wide."""
    random, shape = np.random.default_rng(0), (2000, 10)
    noise = random.standard_normal(shape)

    def side():
        here, there = 0.5 * random.standard_normal((2, *shape))
        return given(noise + here, (3.0 + (there - here) / 0.1)[..., None])

    gradients, *_ = products_of(side(), side(), np.ones(len(noise), bool), loss)
    assert abs(gradients.mean()) < 3.0 * gradients.std() / np.sqrt(len(gradients))


@pytest.mark.parametrize(("above", "below", "mean"), [(0.1, -0.1, 2.01), (0.1, -0.3, 2.03)])
def test_errors_are_the_mean_over_both_ends_and_lead_back_to_the_point(above, below, mean):
    """By hand: errors 2 + 3 p + p², whose mean at a standard error of 0.1 is 2 + 0.1².

    A line through both ends of a parabola passes the point too high by their product.
    """
    point, *ends = (known(np.array(2.0 + 3.0 * p + p**2).reshape(1, 1, 1, 1)) for p in (0.0, above, below))
    errors = np.concatenate([each.mean for each in ends])
    both = replace(point, mean=errors, whole=np.ones((2, 1), bool), members=errors)
    apart, aside = np.array([[above - below]]), np.array([(above + below) / 2.0])
    side = Side(np.zeros((1, 1, 1)), point, both, apart, aside, None)
    np.testing.assert_allclose(side.slopes(), [[[3.0 + above + below]]])
    np.testing.assert_allclose(side.errors(), [[mean]])
    np.testing.assert_allclose(side.found.counted(side.found.whitened[0]), [[2.0]])


def test_predictions_off_a_line_count_with_more_noise():
    """By hand: errors 2, -1 at ends 2 + 3 ± 1 and -1 + 0.5 ± 1, off a line by 3 and 0.5: noise of √82, √3.25."""
    point = known(np.array([2.0, -1.0]).reshape(1, 1, 2, 1))
    ends = known(np.array([[6.0, 0.5], [4.0, -1.5]]).reshape(2, 1, 2, 1))
    side = Side(np.zeros((1, 1, 1)), point, ends, np.array([[0.2]]), np.zeros(1), None)
    np.testing.assert_allclose(side.off_line(), [[9.0, 0.25]])
    gradients, products, _ = products_of(side, side, np.ones(1, bool), "linear")
    np.testing.assert_allclose(side.slopes(), [[[10.0], [10.0]]])
    np.testing.assert_allclose(gradients, [[5.0 * 10.0 / 82.0 - 0.5 * 10.0 / 3.25]])
    np.testing.assert_allclose(products, [[[100.0 / 82.0 + 100.0 / 3.25]]])


def test_steps_are_judged_by_what_chance_makes_of_as_many():
    """By hand: half of all normal values are within 0.6745, and half of all pairs within 1.0518 = z((1 + √½) / 2)."""
    two = np.array([0.1, -2.1036])
    assert instruments.moved_by(np.array([0.6745]), np.ones(1)) == pytest.approx(1.0, rel=1e-4)
    assert instruments.moved_by(two, np.array([1.0, 2.0])) == pytest.approx(1.0, rel=1e-4)
    np.testing.assert_allclose(instruments.beyond_chance(two, np.eye(2), 4), two)
    values = np.array([[1.0, 0.0], [-1.0, 0.0], [1.0, 2.0], [-1.0, 2.0]] * 4)  # T² of (0, 16): 16² / (16 / 15 · 16)
    shorter = instruments.beyond_chance(values.sum(0), values.T @ values, 16) / 16.0
    np.testing.assert_allclose(shorter, [0.0, (1.0 - 2.0 * 15.0 / 12.0 / 15.0) ** 0.5])
    assert not instruments.beyond_chance(np.array([0.1, -0.1]), np.eye(2), 16).any()


def test_the_surprise_of_a_window_is_infinite_where_its_simulation_failed():
    one = known(np.array([[[[2.0], [0.0]], [[1.0], [0.0]]]]))  # two windows of two readings of one channel
    surprise = instruments.surprises(replace(one, whole=np.array([[True, False]])), "linear")
    np.testing.assert_allclose(surprise, [2.0, np.inf])
    assert instruments.over_windows(surprise) == 2.0
    assert instruments.over_windows(np.array([np.inf])) == 0.0
