"""The line that adds a term is given only where the model with it explains the log: on a pendulum, and in words."""

from dataclasses import replace

import numpy as np
import pytest
from test_adequacy import held, term

from madoc.calibration.holdout import RicherModel
from madoc.data import typical_change
from madoc.identification import missing_terms
from madoc.identification.causes import UNEVEN
from madoc.identification.states import states_of
from madoc.identification.term_tests import MissingTerm
from madoc.verdict.mismatch import _advice
from madoc.verdict.remedies import line_of
from madoc.verdict.richer import _next, in_turn, richer_model
from planted_pendulum import plant

WIDTHS = np.array([0.01])


def with_term(dataset, simulator, lacking):
    """The model with the parameter that adds a term, from near the estimate."""
    point = simulator.parameters.to_unit(np.array([0.1]))
    given = dataset, states_of(dataset, simulator), simulator, point, WIDTHS, typical_change(dataset), [lacking]
    return richer_model(*given, most=None)[0]


@pytest.mark.parametrize(
    ("lacks", "parameter"), [({"friction": 0.05}, "dof_frictionloss.hinge"), ({"late": 1}, "action_delay")]
)
def test_a_model_with_what_it_lacks_explains_the_log(tmp_path, lacks, parameter):
    dataset, simulator = plant(tmp_path, **lacks)
    point, change = simulator.parameters.to_unit(np.array([0.1])), typical_change(dataset)
    found = missing_terms.suspicions(dataset, states_of(dataset, simulator), simulator, point, WIDTHS, change).terms
    (lacking,) = (each for each in found if each.parameter == parameter)
    assert with_term(dataset, simulator, lacking) == RicherModel(parameter, ())


def test_a_model_with_something_else_does_not(tmp_path):
    inertia = MissingTerm("inertia", "dof_armature.hinge", 0.01, 0.001, "kg·m²", 0.5, 10.0, {})
    found = with_term(*plant(tmp_path, friction=0.05), inertia)
    assert found.left[0] == "Coulomb friction (dof_frictionloss.hinge)"


def test_the_line_is_given_where_the_model_with_it_explains_the_log_and_no_other_does_nearly():
    friction, spring = term(explained=0.5), term("a spring", parameter="jnt_stiffness.hip", explained=0.45)
    line = "add to the spec's parameters: {field: dof_frictionloss, element: hip, low: 0, high: 2}"
    explains, leaves = RicherModel(friction.parameter, ()), RicherModel(friction.parameter, ("a spring",))
    assert _advice(replace(held(friction), richer=explains), friction) == f"a model with it explains the log: {line}"
    for unsure, told in (
        (held(friction), "was not tested"),
        (replace(held(friction), richer=leaves), "still lacks a spring"),
        (replace(held(friction, spring), richer=explains), "find out on the machine which of them it is"),
    ):
        assert told in _advice(unsure, friction)
        assert line not in _advice(unsure, friction)


def test_what_a_model_with_a_term_still_lacks_is_added_in_turn():
    """Friction at a hip, then at a knee: both lines are given if nothing is left, and else what the first leaves."""
    hip, knee = term(), term(parameter="dof_frictionloss.knee")
    leaves = {1: ("friction at the knee",), 2: ()}

    def tested(terms):
        return RicherModel(terms[0].parameter, leaves[len(terms)], tuple(terms[1:])), knee

    found = in_turn(hip, tested)
    assert _advice(replace(held(hip, knee), richer=found), hip) == (
        "a model with it and friction (dof_frictionloss.knee) explains the log: add to the spec's parameters: "
        "{field: dof_frictionloss, element: hip, low: 0, high: 2} and "
        "{field: dof_frictionloss, element: knee, low: 0, high: 2}"
    )
    leaves |= {2: ("a spring",), 3: ("a spring",)}
    assert in_turn(hip, tested) == RicherModel("dof_frictionloss.hip", ("friction at the knee",))
    assert in_turn(hip, lambda terms: tested(terms) if len(terms) == 1 else None).others == ()
    assert in_turn(hip, lambda terms: None) is None
    late = term(parameter="action_delay")
    assert in_turn(late, tested) == RicherModel("action_delay", ("friction at the knee",))


def test_the_next_term_is_certain_of_a_spec_and_alone():
    friction = term(explained=0.5)
    uneven = term(f"{UNEVEN} (hip)", parameter="", explained=0.45)
    spring = term("a spring", parameter="jnt_stiffness.hip", explained=0.45)
    assert _next([friction, uneven]) == friction  # no spec can say the other
    assert _next([friction, spring]) is None
    assert _next([replace(friction, t=4.9)]) is None and _next([replace(friction, explained=0.019)]) is None
    assert _next([uneven]) is None


def test_a_line_has_room_for_its_value_and_keeps_to_what_is_physical():
    gravity = line_of(MissingTerm("", "gravity", -9.0, 0.1, "m/s²", 0.5, 9.0, {}))
    assert (gravity.low, gravity.high, gravity.elements) == (-18.0, 0.0, ())
    legs = line_of(MissingTerm("", "dof_damping.left+right", 0.1, 0.1, "N·m·s/rad", 0.5, 9.0, {}))
    assert (legs.low, legs.high, legs.elements) == (0.0, 0.8, ("left", "right"))
