"""What is made of a score: physical values, causes and shifts, by hand."""

import numpy as np
import pytest

from madoc.identification.candidate_terms import ON_THE_GROUND, Candidate
from madoc.identification.causes import UNLISTED
from madoc.identification.score_tests import Products, Score
from madoc.identification.term_tests import TermTests, term_of
from madoc.parameters import Parameter, ParameterSpace


def gravity(value, error):
    """Another gravity as a score test finds it, where the model has -9 m/s² and a change of 1 is 9 m/s² more."""
    candidate = Candidate("another gravity", "gravity", "m/s²", -9.0, 9.0, -np.inf, plausible=ON_THE_GROUND)
    found = Score((value + 9.0) / 9.0, error / 9.0, 0.3, np.zeros(1), 50.0)
    return term_of(candidate, found, {})


@pytest.mark.parametrize(("value", "error"), [(-9.81, 0.001), (-9.5, 0.11), (-10.1, 0.11)])
def test_a_plausible_value_is_named(value, error):
    found = gravity(value, error)
    assert (found.cause, found.parameter) == ("another gravity", "gravity")
    assert found.value == pytest.approx(value)


@pytest.mark.parametrize(("value", "error"), [(-9.5, 0.09), (-10.1, 0.09), (3.0, 0.1)])
def test_an_impossible_value_is_a_force_that_acts_like_it(value, error):
    found = gravity(value, error)
    assert found.cause == f"{UNLISTED}, which acts like another gravity of an impossible value"
    assert found.parameter == ""


def test_no_shift_is_larger_than_the_range():
    products = Products.of(np.ones((2, 1)), np.ones((2, 1, 1)), np.ones((2, 1, 0)))
    space = ParameterSpace((Parameter("dof_damping", "hinge", 0.0, 1.0),))
    tests = TermTests(products, (), space, np.array([0.1]), np.zeros(2, np.int64))
    assert tests.by_name(np.array([1e130])) == {"dof_damping.hinge": pytest.approx(20.0)}
    assert tests.by_name(np.array([-0.3])) == {"dof_damping.hinge": pytest.approx(-3.0)}
