"""The time scale of a robot, and what is measured in it."""

from dataclasses import replace

import numpy as np
import pytest

from madoc.data import Dataset, Disturbance, stride, typical_change
from madoc.types import Transitions

PERIOD = 2.0
"""Of the oscillation in s; its mean squared change reaches its variance after a sixth of it, as 2 (1 - cos φ) = 1."""


def swinging(rate: float, *, noise: float = 0.0, seconds: float = 40.0, episodes: int = 2) -> Dataset:
    """An oscillation of amplitude 1 logged at a rate in Hz, in episodes."""
    count = round(seconds * rate) + 1
    angle = np.sin(2.0 * np.pi / PERIOD * np.arange(count) / rate)
    angle = angle + noise * np.random.default_rng(0).standard_normal(count)
    rows = count - 1
    ends = np.zeros(rows, dtype=bool)
    starts = np.linspace(0, rows, episodes, endpoint=False).astype(np.int64)
    ends[np.append(starts, rows)[1:] - 1] = True
    quiet = np.zeros(rows)
    transitions = Transitions(angle[:-1, None], quiet[:, None], quiet, angle[1:, None], ~np.ones(rows, bool), ends)
    return Dataset(transitions, starts, "swing", "modern", "a test")


@pytest.mark.parametrize(("rate", "noise"), [(30.0, 0.0), (300.0, 0.0), (300.0, 0.05)])
def test_the_time_scale_depends_neither_on_the_rate_nor_on_noise(rate: float, noise: float) -> None:
    log = swinging(rate, noise=noise)
    assert log.time_scale / rate == pytest.approx(PERIOD / 6.0, rel=0.05, abs=1.1 / rate)


def test_the_time_scale_of_a_long_log_is_that_of_all_of_it() -> None:
    """At 500 Hz the robot rests for 44 s, which are 22,000 rows, and swings for as long; lags are 11 % apart."""
    log = swinging(500.0, seconds=88.0)
    half = log.episode_starts[1]
    angle, following = (np.array(part) for part in (log.transitions.observation, log.transitions.next_observation))
    angle[:half], following[:half] = 0.0, 0.0
    rested = replace(log, transitions=replace(log.transitions, observation=angle, next_observation=following))
    assert rested.time_scale / 500.0 == pytest.approx(PERIOD / 6.0, rel=0.11)


def test_a_motion_whose_period_is_that_of_thinned_rows_is_seen_in_all_of_its_poses() -> None:
    """At 10 Hz a period is twenty rows, of which one is compared: 1 - cos φ is 0.41 after three rows, 0.69 after four.

    From the first of every twenty rows alone the angle has changed by sin φ, whose square is 0.65 after three.
    """
    assert swinging(10.0, seconds=40_000.0, episodes=1).time_scale == 4


def test_a_stride_is_a_twentieth_of_it_and_a_row_at_least() -> None:
    assert (stride(swinging(30.0)), stride(swinging(300.0))) == (1, 5)
    lost = replace(swinging(300.0), disturbance=Disturbance(shuffled="rows"))
    assert (lost.time_scale, stride(lost)) == (1, 1)


def test_a_typical_change_is_that_of_a_stride() -> None:
    # a sine changes by 2 sin(π / 60) cos(...) in a 60th of its period: the root mean square of that
    expected = 2.0 * np.sin(np.pi * 5.0 / 600.0) / np.sqrt(2.0)
    assert typical_change(swinging(300.0)) == pytest.approx([expected], rel=0.02)
