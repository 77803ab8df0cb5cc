import jax
import jax.numpy as jnp
import numpy as np
import pytest

from madoc.learning import replay


def batch(*numbers):
    """Rows told apart by one number, in two columns."""
    numbers = np.asarray(numbers, np.float32)
    return {"scalar": numbers, "pair": np.stack([numbers, -numbers], axis=-1)}


def filled(capacity, *batches):
    ring = replay.empty(capacity, scalar=(), pair=(2,))
    for numbers in batches:
        ring = replay.add(ring, batch(*numbers), np.ones(len(numbers), bool))
    return ring


def test_empty_has_the_asked_columns():
    ring = replay.empty(5, scalar=(), pair=(2,), image=(3, 4))
    assert ring.capacity == 5
    assert ring.written == 0
    assert {name: column.shape for name, column in ring.rows.items()} == {
        "scalar": (5,),
        "pair": (5, 2),
        "image": (5, 3, 4),
    }


def test_rows_lie_in_the_order_they_came():
    ring = filled(6, (1, 2), (3,), (4, 5))
    assert ring.written == 5
    np.testing.assert_array_equal(ring.rows["scalar"], [1, 2, 3, 4, 5, 0])
    np.testing.assert_array_equal(ring.rows["pair"][2], [3, -3])


def test_the_oldest_rows_are_overwritten():
    ring = filled(4, (1, 2, 3), (4, 5, 6))
    assert ring.written == 6
    np.testing.assert_array_equal(ring.rows["scalar"], [5, 6, 3, 4])  # 5 over 1, 6 over 2
    np.testing.assert_array_equal(ring.rows["pair"][:, 1], [-5, -6, -3, -4])


def test_wrapping_again_and_again_keeps_the_last_rows():
    ring = filled(5, *(range(start, start + 3) for start in range(0, 30, 3)))
    assert sorted(np.asarray(ring.rows["scalar"]).tolist()) == [25, 26, 27, 28, 29]
    assert ring.written == 30


def test_a_batch_larger_than_the_ring_leaves_its_last_rows():
    ring = filled(3, (1,), (2, 3, 4, 5, 6, 7, 8))
    # row n (counted from 0) lies at n mod 3: 6 is row 5, 7 row 6, 8 row 7
    np.testing.assert_array_equal(ring.rows["scalar"], [7, 8, 6])
    np.testing.assert_array_equal(ring.rows["pair"][:, 1], [-7, -8, -6])
    assert ring.written == 8


def test_invalid_rows_are_dropped_and_leave_no_hole():
    ring = replay.empty(4, scalar=(), pair=(2,))
    ring = replay.add(ring, batch(1, np.nan, 3, np.nan), np.array([True, False, True, False]))
    assert ring.written == 2
    np.testing.assert_array_equal(ring.rows["scalar"], [1, 3, 0, 0])
    ring = replay.add(ring, batch(np.nan, 5, 6, 7), np.array([False, True, True, True]))
    np.testing.assert_array_equal(ring.rows["scalar"], [7, 3, 5, 6])
    ring = replay.add(ring, batch(8, 9), np.zeros(2, bool))
    np.testing.assert_array_equal(ring.rows["scalar"], [7, 3, 5, 6])
    assert ring.written == 5


def test_sampling_sees_only_what_was_written(compiled):
    drawn = compiled(replay.sample)(filled(1000, (1, 2, 3)), jax.random.key(0), 3000)
    numbers, counts = np.unique(drawn["scalar"], return_counts=True)
    np.testing.assert_array_equal(numbers, [1, 2, 3])
    assert counts.min() > 850  # 1000 each on average, std 26
    np.testing.assert_array_equal(drawn["pair"][:, 0], drawn["scalar"])
    np.testing.assert_array_equal(drawn["pair"][:, 1], -drawn["scalar"])


def test_sampling_a_full_ring_sees_every_row():
    drawn = replay.sample(filled(4, (1, 2, 3), (4, 5, 6)), jax.random.key(0), 500)
    np.testing.assert_array_equal(np.unique(drawn["scalar"]), [3, 4, 5, 6])


def test_clear_forgets():
    ring = replay.clear(filled(4, (1, 2, 3)))
    assert ring.written == 0
    assert ring.capacity == 4
    ring = replay.add(ring, batch(9), np.ones(1, bool))
    np.testing.assert_array_equal(np.unique(replay.sample(ring, jax.random.key(0), 50)["scalar"]), [9])


def test_the_replay_given_is_consumed():
    ring = replay.empty(8, scalar=(), pair=(2,))
    replay.add(ring, batch(1, 2), np.ones(2, bool))
    assert ring.rows["scalar"].is_deleted()
    with pytest.raises(RuntimeError, match="deleted"):
        np.asarray(ring.rows["pair"])


def test_adding_traces_once(traced):
    ring = filled(6, (1, 2))
    before = traced()
    for number in range(10):
        ring = replay.add(ring, batch(number, number), np.array([True, number % 2 == 0]))
    assert traced() == before
    assert ring.written == 17


def test_flatten_rows_merges_leading_axes():
    column = np.arange(24, dtype=np.float64).reshape(2, 3, 2, 2)
    flat = replay.flatten_rows(column, 3)
    assert flat.shape == (12, 2)
    assert flat.dtype == np.float32
    np.testing.assert_array_equal(flat[5], column[0, 2, 1])  # (0·3 + 2)·2 + 1 = 5
    assert replay.flatten_rows(np.zeros((2, 3, 2)), 3).shape == (12,)


def test_rows_keep_their_columns_on_the_device():
    ring = filled(4, (1, 2))
    assert all(isinstance(column, jax.Array) and column.dtype == jnp.float32 for column in ring.rows.values())
