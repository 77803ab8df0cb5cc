"""What is told of what a model lacks, by hand."""

from dataclasses import replace

from test_judge import PREDICTED, predicted_over

from madoc.identification.term_tests import MissingTerm
from madoc.verdict import judge


def test_an_end_of_a_range_is_told_beside_a_term_though_that_leaves_the_parameter_open():
    offset = MissingTerm("an offset of the sensor", "signal_bias.hip", 0.1, 0.01, "1", 0.8, 10.0, {"mass": 0.1})
    useful = {"open_loop": (predicted_over(1.0, 0.4, (0.3, 0.6)),)}
    verdict = judge(replace(PREDICTED, missing_terms=(offset,), open_at_end=("damping",), **useful))
    assert verdict.word == "USABLE"
    assert verdict.sentence.endswith(
        "damping at the end of the range: the true value may lie beyond it, so widen it first"
    )
    unsettled = judge(replace(PREDICTED, missing_terms=(offset,), open_at_end=("damping",)), settled=False)
    assert "damping at the end" not in unsettled.sentence
