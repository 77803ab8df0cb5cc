"""Mean and deviation of rows that come in batches are those of all rows at a time."""

import numpy as np

from madoc.policies.interaction import Moments


def test_batches_add_up_to_all_rows():
    rows = np.random.default_rng(0).normal([3.0, -100.0], [0.1, 20.0], (70, 2))
    moments = Moments.none(2)
    for batch in np.split(rows, [1, 1, 30]):  # one of them is empty
        moments = moments.including(batch)
    assert moments.count == 70
    np.testing.assert_allclose(moments.mean, rows.mean(0))
    np.testing.assert_allclose(moments.deviation, rows.std(0))


def test_before_the_first_row_nothing_is_scaled():
    moments = Moments.none(3)
    np.testing.assert_array_equal(moments.mean, np.zeros(3))
    np.testing.assert_array_equal(moments.deviation, np.ones(3))
