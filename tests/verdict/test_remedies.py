"""What is told of a missing term, by hand."""

from madoc.identification.term_tests import MissingTerm
from madoc.verdict.remedies import value_of


def test_the_error_told_of_a_term_is_that_of_its_t():
    """Of few windows a ratio of 20 is as likely by chance as a normal deviate of 8: 0.4 is told with 0.05, not 0.02."""
    found = MissingTerm("drag", "dof_drag.hip", 0.5, 0.02, "1", 0.8, 8.0, {"mass": 0.1}, nominal=0.1)
    assert value_of(found) == "0.5 ± 0.05 (the model has 0.1)"
