"""Sentences that go with an estimate."""

from madoc.calibration.cautions import without_repeats


def test_what_method_and_check_both_say_is_without_repeats():
    own = ["the data does not identify mass, gain together; leave one out", "at the end of its range: damping"]
    doubts = [f"parameters: {own[0]}", "run.csv: the run is cut there"]
    assert without_repeats(own, doubts) == [*own, "run.csv: the run is cut there"]
