import numpy as np

from madoc.verdict.two_sample import Sample, classify


def sample(seed, rows, *, moved=0.0, shift=0.0):
    rng = np.random.default_rng(seed)
    before = rng.standard_normal((rows, 2)) + shift
    after = before[:, :1] + moved + rng.standard_normal((rows, 1))
    return Sample(before, after)


def test_rows_of_one_kind_cannot_be_told_apart():
    told = classify(sample(0, 400), sample(1, 400))
    assert told.interval[0] < 0.5 < told.interval[1]
    assert told.rows == 800


def test_other_dynamics_are_told():
    told = classify(sample(0, 400), sample(1, 400, moved=2.0))
    assert told.interval[0] > 0.8


def test_where_rows_were_is_weighed_out_and_what_followed_is_not():
    there, elsewhere = sample(0, 1000), sample(1, 1000, shift=0.7)
    seen = (np.concatenate([each.before, each.after], axis=1) for each in (there, elsewhere))
    plain = classify(*(Sample(np.zeros((1000, 1)), rows) for rows in seen)).area  # nothing before to weigh by
    weighed = classify(there, elsewhere).area
    assert plain > 0.6
    assert abs(weighed - 0.5) < 0.5 * abs(plain - 0.5)
    assert classify(there, sample(1, 1000, shift=0.7, moved=2.0)).interval[0] > 0.7


def test_the_same_rows_give_the_same_bits():
    first, again = (classify(sample(0, 100), sample(1, 120, moved=0.3)) for _ in range(2))
    assert first == again
