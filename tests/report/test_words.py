import math
from dataclasses import replace

import pytest
from run_folders import result

from madoc.calibration import CalibrationResult
from madoc.report.words import count, duration, memory, number, to_do, with_error


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (0.0, "0"),
        (-9.862981, "−9.863"),
        (61088.4, "61 088"),
        (1234.6, "1 235"),
        (0.00012345, "0.0001234"),
        (1.43e-15, "1.43·10⁻¹⁵"),
        (-2.5e8, "−2.50·10⁸"),
        (math.nan, "–"),
        (None, "–"),
    ],
)
def test_numbers_have_their_digits_and_a_real_minus(value, written):
    assert number(value) == written


@pytest.mark.parametrize(
    ("seconds", "written"),
    [(0.84, "0.8 s"), (42.4, "42 s"), (59.7, "1 min 0 s"), (106.3, "1 min 46 s"), (7801, "2 h 10 min")],
)
def test_durations_are_read_at_a_glance(seconds, written):
    assert duration(seconds) == written


def test_memory_is_told_in_megabytes_up_to_a_thousand():
    assert [memory(size) for size in (398_400_000, 999_600_000, 1_053_000_000)] == ["398 MB", "1.00 GB", "1.05 GB"]


def test_counts_keep_thousands_apart():
    assert count(1_500_000) == "1 500 000"


@pytest.mark.parametrize(
    ("value", "error", "words"),
    [
        (-9.80642, 0.00122, "−9.8064 ± 0.0012"),
        (8.664, 1.48, "8.7 ± 1.5"),
        (0.5587, 0.0, "0.559"),
        (float("nan"), 0.1, "–"),
    ],
)
def test_an_error_has_two_digits_and_its_value_as_many_decimals(value, error, words):
    assert with_error(value, error) == words


def result_of(word, *, status="converged", **changes):
    """A result with a verdict, and a hold-out if that is changed."""
    judged = {"verdict": {"word": word, "sentence": "s"}, "status": status}
    found = CalibrationResult.from_json(result(**judged))
    return replace(found, holdout=replace(found.holdout, **changes))


def test_a_search_that_its_budget_has_ended_is_to_be_resumed_before_anything_else():
    """Only `USABLE` has something better than itself; what the other words ask for does not depend on the search."""
    assert "; better, find what the model lacks" in to_do(result_of("USABLE"))
    resumed = to_do(result_of("USABLE", status="finished"))
    assert resumed.endswith("; better, resume the search with a larger budget (--resume, --budget)")
    assert resumed.startswith("use the calibrated model in MuJoCo as it is") and "lacks" not in resumed
    assert to_do(result_of("NO_IMPROVEMENT", status="finished")) == to_do(result_of("NO_IMPROVEMENT"))


@pytest.mark.parametrize("left", [{"tested": False}, {"open_in_time": ("gravity",)}])
def test_what_was_not_tested_is_to_be_tested_before_anything_is_looked_for(left):
    assert "; better, first give it a larger budget (--budget) or a longer log" in to_do(result_of("USABLE", **left))
    assert to_do(result_of("NOT_IDENTIFIABLE", **left)) == to_do(result_of("NOT_IDENTIFIABLE"))
