from dataclasses import replace

import numpy as np
import pytest

from madoc.calibration.holdout import PredictionError, PredictionErrors
from madoc.verdict.mismatch import at_most
from madoc.verdict.statistics import (
    better_than_chance,
    beyond_noise,
    hides_gain,
    independent_groups,
    interval_of,
    resampled,
)


def test_the_interval_of_a_mean_is_as_wide_as_its_standard_error_says():
    values = np.random.default_rng(1).standard_normal(400)
    low, high = interval_of(resampled(values, np.arange(400)))
    assert high - low == pytest.approx(2 * 1.96 / 20, rel=0.15)


def test_rows_of_one_episode_are_resampled_together():
    # Forty rows of each of ten episodes say no more than the ten.
    level = np.random.default_rng(1).standard_normal(10)
    rows, episodes = np.repeat(level, 40), np.repeat(np.arange(10), 40)
    together, apart = (np.diff(interval_of(resampled(rows, groups)))[0] for groups in (episodes, np.arange(400)))
    assert together == pytest.approx(np.sqrt(40) * apart, rel=0.3)


def test_overlapping_windows_of_few_episodes_are_resampled_together():
    # Means of 20 consecutive noises, at every row: 400 windows tell as much as 20 that do not overlap.
    groups, widths = independent_groups(np.zeros(400, int), np.arange(400), 20), []
    assert len(np.unique(groups)) == 10
    for seed in range(20):
        noise = np.random.default_rng(seed).standard_normal(419)
        widths += np.diff(interval_of(resampled(np.convolve(noise, np.full(20, 0.05), "valid"), groups))).tolist()
    assert np.mean(widths) == pytest.approx(2 * 1.96 / 20, rel=0.2)


def test_windows_that_share_all_rows_are_five_groups():
    assert independent_groups(np.zeros(10, int), np.arange(10), 50).tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]


def test_stretches_of_few_episodes_do_not_join_them():
    # Two episodes of 100 rows that begin anywhere: five stretches of 20 rows each.
    episodes, rows = np.repeat([0, 1], 100), np.concatenate([np.arange(7, 107), np.arange(130, 230)])
    groups = independent_groups(episodes, rows, 10)
    assert (np.bincount(groups) == 20).all()
    assert (groups == np.repeat(np.arange(10), 20)).all()


def test_five_episodes_are_groups():
    episodes = np.repeat(np.arange(5), 40)
    assert (independent_groups(episodes, np.arange(200), 20) == episodes).all()


def test_right_predictions_are_better_than_chance_and_shuffled_ones_are_not():
    rng = np.random.default_rng(3)
    followed = rng.standard_normal((200, 2))
    groups = np.repeat(np.arange(4), 50)
    skill, p_value = better_than_chance(followed + 0.1 * rng.standard_normal((200, 2)), followed, groups)
    assert p_value == pytest.approx(1 / 500)
    assert skill > 0.8
    skill, p_value = better_than_chance(rng.permutation(followed), followed, groups)
    assert p_value > 0.01
    assert abs(skill) < 0.1


def test_telling_one_run_from_another_is_no_skill():
    level = np.repeat(np.arange(4.0), 50)[:, None]
    noise = 0.01 * np.random.default_rng(4).standard_normal((2, 200, 1))
    _, p_value = better_than_chance(level + noise[0], level + noise[1], np.repeat(np.arange(4), 50))
    assert p_value > 0.01


def test_rows_of_their_own_are_exchanged_with_any():
    followed = np.random.default_rng(5).standard_normal((60, 1))
    assert better_than_chance(followed, followed, np.arange(60))[0] == 1.0


def test_noise_hides_the_gain_where_mid_range_errs_by_no_more_than_noise_does():
    def errors(*means):
        return tuple(PredictionError(steps, mean, (mean, mean)) for steps, mean in zip((1, 20), means, strict=True))

    hidden = PredictionErrors(
        **{"mid_range": errors(0.12, 0.3), "estimate": errors(0.1, 0.3), "nearby_best": errors(0.1, 0.3)},
        **{"noise": errors(0.1, 0.2), "relative": 1.0, "relative_interval": (0.9, 1.1), "nearby_relative": 0.99},
        windows=400,
    )
    assert hides_gain(hidden)
    assert not hides_gain(replace(hidden, nearby_relative=0.5))
    assert not hides_gain(replace(hidden, mid_range=errors(0.12, 0.5)))
    assert not hides_gain(replace(hidden, noise=errors(0.0, 0.0), mid_range=errors(0.0, 0.0)))


def test_at_most_is_rounded_up():
    assert list(map(at_most, (0.1131, 0.01125, 0.011, 0.0))) == ["12 %", "1.2 %", "1.1 %", "0 %"]


def test_errors_of_a_few_windows_are_certainly_beyond_noise_only_by_their_interval():
    noise = PredictionError(5, 0.054, (0.04, 0.07))
    few, many = PredictionError(5, 0.11, (0.09, 0.13)), PredictionError(5, 0.11, (0.109, 0.111))
    assert beyond_noise([few], [noise]) == [(few, noise)]
    assert beyond_noise([few], [noise], certain=True) == []
    assert beyond_noise([many], [noise], certain=True) == [(many, noise)]
