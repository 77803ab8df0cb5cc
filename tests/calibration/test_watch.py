"""Madoc's watch, on metrics made by hand."""

import numpy as np
import pytest

from madoc.calibration.madoc.agents import Actors, AgentSettings, initial_actors
from madoc.calibration.madoc.watch import (
    CLOSE,
    SATURATED,
    SETTLING,
    SMOOTHING,
    Watch,
    beats_mid_range,
    observe,
    stalled,
    warnings,
)
from madoc.parameters import Parameter, ParameterSpace

SMALLEST, LARGEST = 0.02, 0.3


def actors(value):
    return Actors(np.full(2, value, np.float32), np.zeros(2, np.float32))


def watched(watch, epochs, *, blur=None, size=1.0, at_bound=0.0, estimate=0.0, steered_to=1.0, gain=1.0):
    metrics = {"reward_size": size, "reward_at_bound": at_bound, "overlap": 0.5}
    metrics |= {} if blur is None else {"blur": blur}
    settings = AgentSettings(reward_size=steered_to, smallest_blur=SMALLEST, first_blur=LARGEST, largest_blur=LARGEST)
    for _ in range(epochs):
        watch = observe(watch, metrics, actors(estimate), gain, settings)
    return watch


def begun():
    return Watch(initial_actors(2))


def settled(**metrics):
    return watched(begun(), SETTLING, **metrics)


def test_the_mismatch_is_a_running_average_that_begins_at_the_first_epoch():
    first = watched(begun(), 1, blur=0.2, at_bound=0.4)
    assert (first.mismatch, first.at_bound, first.epochs) == (0.2, 0.4, 1)
    second = watched(first, 1, blur=0.1, at_bound=0.0)
    assert second.mismatch == pytest.approx(0.2 + SMOOTHING * (0.1 - 0.2))
    assert second.at_bound == pytest.approx(0.4 * (1 - SMOOTHING))


def test_a_blur_at_which_discriminators_are_surer_than_wanted_stands_for_a_larger_mismatch():
    assert watched(begun(), 1, blur=0.1, size=3.0, steered_to=2.0).mismatch == pytest.approx(0.15)


def test_until_the_discriminators_have_settled_the_latest_estimate_is_the_best():
    watch = settled(blur=0.01, estimate=0.1)  # mismatches that will never be as low again
    assert float(watch.best.mean[0]) == pytest.approx(0.1)
    assert watch.milestone_epoch == SETTLING


def test_the_estimate_of_the_lowest_mismatch_is_kept():
    watch = settled(blur=0.2, estimate=0.1)
    better = watched(watch, 40, blur=0.1, estimate=0.5)
    rising = watched(better, 3, blur=0.25, estimate=0.5)
    worse = watched(rising, 40, blur=0.25, estimate=0.9)
    assert float(worse.best.mean[0]) == pytest.approx(0.5)
    assert worse.best_mismatch == better.best_mismatch
    assert SETTLING < worse.milestone_epoch <= SETTLING + 40


def test_of_mismatches_as_low_the_latest_estimate_is_kept():
    watch = watched(settled(blur=0.1, estimate=0.1), 40, blur=0.1 * (1 + 0.8 * CLOSE), estimate=0.5)
    assert float(watch.best.mean[0]) == pytest.approx(0.5)
    assert watch.best_mismatch == pytest.approx(0.1)


def test_a_blur_at_its_smallest_is_told_by_the_reward():
    watch = settled(blur=SMALLEST, size=1.0, estimate=0.1)
    unsure = watched(watch, 40, blur=SMALLEST, size=0.3, estimate=0.7)
    assert float(unsure.best.mean[0]) == pytest.approx(0.7) and unsure.best_mismatch < 0.4 * SMALLEST


def test_rewards_at_their_bound_under_the_largest_blur_say_nothing_yet():
    watch = watched(settled(blur=LARGEST, at_bound=0.9), 10, blur=LARGEST, at_bound=0.9, size=3.0, estimate=0.7)
    assert float(watch.best.mean[0]) == pytest.approx(0.7)
    assert watch.milestone_epoch == watch.epochs


def test_under_the_largest_blur_a_mismatch_that_rises_is_no_progress():
    watch = settled(blur=LARGEST, size=1.0, estimate=0.1)
    rising = watched(watch, 40, blur=LARGEST, size=6.0, estimate=0.7)
    assert float(rising.best.mean[0]) == pytest.approx(0.1)
    assert rising.milestone_epoch == SETTLING


def test_a_blur_at_which_nothing_can_be_told_does_not_count():
    watch = settled(blur=0.2, estimate=0.1)
    assert watched(watch, 20, blur=0.05, size=0.1, estimate=0.7).best is watch.best


def test_a_crumb_is_better_but_no_progress():
    watch = settled(blur=0.2, estimate=0.1)
    crumb = watched(watch, 1, blur=0.199, estimate=0.3)
    assert float(crumb.best.mean[0]) == pytest.approx(0.3)
    assert crumb.milestone_epoch == watch.milestone_epoch


def test_without_a_blur_the_latest_estimate_is_taken_and_it_never_stalls():
    watch = watched(begun(), 3 * SETTLING, size=2.0, steered_to=0.0)
    watch = watched(watch, 1, size=3.0, steered_to=0.0, estimate=0.6)
    assert float(watch.best.mean[0]) == pytest.approx(0.6)
    assert stalled(watch, 1) is None


def test_it_stops_after_so_many_epochs_without_progress():
    watch = settled(blur=0.2)
    assert stalled(watched(watch, 19, blur=0.2), 20) is None
    sentence = stalled(watched(watch, 20, blur=0.2), 20)
    assert sentence.startswith("the mismatch of simulated and logged rows has stayed at")
    assert sentence.endswith("0.2 for 20 epochs")
    assert stalled(watched(watch, 20, blur=0.05), 20) is None


def test_crumbs_add_up_to_progress():
    watch = settled(blur=0.2)
    for step in range(100):
        watch = watched(watch, 1, blur=0.2 - 0.001 * step)
    assert stalled(watch, 10) is None


SPACE = ParameterSpace(
    (Parameter("body_mass", "cart", 1.0, 2.0, "mass"), Parameter("dof_damping", "slide", 0.1, 1.0, "damping"))
)


def warned(watch=None, unit=(0.0, 0.0)):
    return warnings(watch or settled(blur=0.1), np.array(unit), SPACE)


def test_a_healthy_run_is_not_warned_of():
    assert warned(unit=(-0.97, 0.97)) == ()


def test_a_parameter_at_the_end_of_its_range_is_named():
    (warning,) = warned(unit=(0.5, -0.99))
    assert warning == "at the end of its range: damping; widen the range or doubt the model"
    assert "mass, damping" in warned(unit=(1.0, -0.99))[0]


def test_a_saturated_reward_is_warned():
    (warning,) = warned(settled(blur=0.1, at_bound=0.75))
    assert "sure of 75% of the simulated rows (reward at its bound)" in warning
    assert warning.endswith("has no slope; narrow the ranges")  # as rollouts cannot start elsewhere
    assert warned(settled(blur=0.1, at_bound=SATURATED - 0.01)) == ()


def test_saturation_long_past_is_forgotten():
    assert warned(watched(settled(blur=0.1, at_bound=1.0), 30, blur=0.1)) == ()


def test_too_few_epochs_are_warned():
    (warning,) = warned(watched(begun(), 3, blur=0.1))
    assert "3 epochs of calibration" in warning
    assert "larger budget" in warning


def test_warnings_add_up():
    assert len(warned(watched(begun(), 3, blur=0.1, at_bound=1.0), unit=(1.0, 0.0))) == 3


def scattered(mean, seed, epochs=400):
    """A watch of gains over mid-range that scatter by 1 about their mean."""
    watch = settled(blur=0.1)
    for gain in np.random.default_rng(seed).normal(mean, 1.0, epochs):
        watch = watched(watch, 1, blur=0.1, gain=float(gain))
    return watch


def test_an_estimate_that_gains_nothing_over_mid_range_is_told():
    # 2 standard errors of an average with the rate 0.02: a mean of 0 is beyond them in 2 %, one of 0.5 in all but few.
    assert sum(beats_mid_range(scattered(0.0, seed)) for seed in range(30)) <= 3
    assert sum(beats_mid_range(scattered(0.5, seed)) for seed in range(30)) >= 27
    (warning,) = warned(watched(settled(blur=0.1), 1, blur=0.1, gain=-9.0))
    assert warning.startswith("rows simulated at the estimate do not look more like the log's than rows at mid-range")


def test_gains_before_the_discriminators_have_settled_are_forgotten():
    assert beats_mid_range(watched(watched(begun(), SETTLING, blur=0.1, gain=-9.0), 2, blur=0.1, gain=0.1))
