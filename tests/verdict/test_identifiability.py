"""What a log could tell at best."""

import numpy as np
import pytest

from madoc.identification.excitation import widened
from madoc.verdict.identifiability import open_shares


def test_an_open_direction_is_as_long_as_the_box():
    direction = np.array([0.6, 0.8])
    across = np.array([0.8, -0.6])
    covariance = np.outer(direction, direction) / 3 + 1e-6 * np.outer(across, across)
    # along (0.6, 0.8) the second reaches its end first: there the first stands at 0.75
    expected = np.array([0.75, 1.0]) * np.sqrt(1 / 3)
    assert np.sqrt(np.diag(widened(covariance))) == pytest.approx(expected, rel=1e-5)


def test_what_is_told_stays_as_it_is():
    covariance = np.array([[0.02, 0.01], [0.01, 0.03]])
    assert widened(covariance) == pytest.approx(covariance, rel=1e-12)


def test_shares_are_the_wider_interval_and_at_most_everything():
    interval = np.array([[1.0, 2.0], [0.0, 1.0], [-5.0, 5.0]])
    shares = open_shares(np.array([0.1, 0.6, 0.2]), interval, np.array([4.0, 4.0, 4.0]))
    assert shares.tolist() == [0.25, 0.6, 1.0]
    assert open_shares(np.array([0.1, 3.0]), None, np.ones(2)).tolist() == [0.1, 1.0]
