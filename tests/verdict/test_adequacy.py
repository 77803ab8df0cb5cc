"""Intervals that cover what the log does not exclude, and the term that is named, from numbers chosen by hand."""

from dataclasses import replace

import numpy as np
import pytest
from test_judge import PREDICTED

from madoc.calibration.holdout import AgainstChance, Area, OpenLoop, ToldApart
from madoc.calibration.result import CalibrationResult, ParameterEstimate
from madoc.identification.causes import DRIFT, INTEGRATION, TILTS, UNLISTED, WEAKENING, WEAKENING_ALL
from madoc.identification.combinations import Combination
from madoc.identification.term_tests import Alternative, ImitatedTerm, MissingTerm
from madoc.verdict import judge
from madoc.verdict.adequacy import (
    SURER,
    about_imitated,
    as_likely,
    in_full,
    likeliest,
    missing_term,
    numerical,
    of_small_terms,
    widening,
    with_widened_intervals,
)

BEYOND = Alternative(("a spring",), {"mass": 3.0, "damping": -0.5}, {"mass": 0.0, "damping": 2.4 / SURER})


def term(cause="friction", t=8.0, shift=2.0, explained=0.1, parameter="dof_frictionloss.hip"):
    return MissingTerm(cause, parameter, 1.0, 1.0 / abs(t), "N·m", explained, t, {"mass": shift})


def held(*terms, alternatives=()):
    area = Area(0.5, (0.4, 0.6), 400)
    chance = (AgainstChance("the simulator", 0.9, 0.002),)
    return ToldApart(
        **{
            "split": "",
            "rows": 400,
            "episodes": 1,
            "estimate": {},
            "values": {"mass": (1.2, 0.01, "kg")},
            "interval_shares": {},
            "against_chance": chance,
        },
        **{"noise": {}, "control_steps": 0, "area_at_mid_range": area, "area_at_estimate": area},
        missing_terms=terms,
        alternatives=alternatives,
    )


def test_each_end_moves_out_to_the_alternatives_own_interval():
    # 3 ± 1 moves the high end of ±1 by 3. An error of 2.4 at 99 %: -0.5 ± √(1 + 2.4²) = -0.5 ± 2.6 moves the ends by
    # 2.1 and 1.1.
    assert widening((BEYOND,), ("mass", "damping", "gain")) == pytest.approx(
        np.array([[0.0, 3.0], [2.1, 1.1], [0.0, 0.0]])
    )


def test_all_of_what_bounds_hold_is_covered_with_its_own_interval():
    # Values from 0 to 4 have intervals of ±1 each: from -1 to 5.
    bounded = Alternative(("steps",), {"mass": 2.0}, {"mass": 2.0}, bounded=True)
    assert widening((bounded,), ("mass",)) == pytest.approx(np.array([[0.0, 4.0]]))


def test_intervals_and_combinations_cover_the_alternatives():
    rows = {
        "mass": ParameterEstimate(1.0, 0.05, 0.0, 1.25, "kg", [0.9, 1.1]),
        "damping": ParameterEstimate(0.5, 0.1, 0.0, 2.0, "N·s/m", [0.4, 0.6]),
    }
    both = Combination("mass + 2·damping", {"mass": 1.0, "damping": 2.0}, "sum", 2.0, (1.9, 2.1), "kg")
    result = CalibrationResult("m", "t", "finished", "", 0, 0.0, 0, [], rows, combinations=[both])
    wide = with_widened_intervals(result, held(alternatives=(BEYOND,)))
    assert wide.parameters["mass"].interval == pytest.approx([0.9, 1.25])  # 1.4, but for the end of its range
    assert wide.parameters["damping"].interval == pytest.approx([0.19, 0.71])
    # The sum moves by 0.1 · 3 - 2 · 0.1 · 0.5 = 0.2, known to 2 · 0.1 · 2.4 = 0.48.
    assert wide.combinations[0].interval[1] == pytest.approx(2.2 + np.hypot(0.1, 0.48))
    told = (
        "95 % intervals are wider than the standard deviations, which count noise alone: they also cover what the data "
        "does not exclude, "
    )
    assert wide.warnings == [told + "a spring"]
    names = ("drag", "friction", "lag", "a load", "no move")
    shifts = (0.5, 3.0, 2.0, 2.5, 0.0)
    lesser = [
        replace(BEYOND, causes=(name,), shifts={"mass": shift}) for name, shift in zip(names, shifts, strict=True)
    ]
    lesser[-1] = replace(lesser[-1], errors={"mass": 0.0})
    wide = with_widened_intervals(result, held(alternatives=tuple(lesser)))
    assert wide.warnings == [told + "friction, a load, lag and 1 more effect"]


def test_terms_that_parameters_imitate_are_told():
    imitated = (ImitatedTerm("a spring", "jnt_stiffness.hinge", ("mass", "damping")),)
    assert about_imitated(held()) == ()
    (told,) = about_imitated(replace(held(), imitated=imitated))
    assert told.startswith("the log cannot tell a spring (jnt_stiffness.hinge) from mass and damping: estimates assume")
    (told,) = about_imitated(replace(held(), imitated=5 * imitated))
    assert told.count("a spring") == 3
    assert "mass and damping; 2 more terms: estimates assume" in told


def test_other_estimates_by_a_coarse_step_are_taken_in_full():
    """At a value of a half, a shift of 3 half-widths is one of 6; what other terms do is as it is."""
    step = replace(term(INTEGRATION, t=20.0, explained=0.4, parameter=""), value=0.5)
    by_step = Alternative((INTEGRATION,), {"mass": 3.0}, {"mass": 0.5})
    (full,) = in_full((by_step,), [step])
    assert (full.shifts, full.errors) == ({"mass": 6.0}, {"mass": 1.0})
    spring = replace(by_step, causes=("a spring",))
    assert in_full((spring,), [step]) == (spring,)
    assert in_full((by_step,), [replace(step, explained=0.1)]) == (by_step,)


def test_the_term_that_explains_most_is_named():
    friction, spring = term(explained=0.2), term("a spring", t=30.0, explained=0.05, parameter="jnt_stiffness.hip")
    assert missing_term(held(spring, friction)) is friction


def test_small_terms_are_covered_by_intervals_and_not_named():
    """A term of t = 8 that moves a mass by 4 half-widths is known to 1.96 · 4 / 8 = 0.98 of them."""
    small = replace(term("a gain", t=8.0, explained=0.01), shifts={"mass": 4.0})
    assert missing_term(held(small)) is None
    assert missing_term(held(small), least=0.0) is small
    (other,) = of_small_terms([small, term(explained=0.2), term("a clock", t=4.0, explained=0.01)])
    assert (other.causes, other.shifts) == (("a gain (dof_frictionloss.hip)",), {"mass": 4.0})
    assert other.errors["mass"] == pytest.approx(0.98, abs=1e-3)
    change = term(DRIFT, t=9.0, explained=0.0)
    assert missing_term(held(change)) is change


def test_a_certain_term_of_a_thousandth_is_never_calibrated():
    least = replace(term(t=5.1, explained=0.004), cause="another centre of mass", parameter="body_com.leg")
    sure = judge(replace(PREDICTED, missing_terms=(least,)))
    assert sure.word == "NOT_IDENTIFIABLE"
    assert "another centre of mass (body_com.leg) explains only 0.4 % of the squared residuals, but" in sure.sentence
    ahead = OpenLoop(1.0, False, 60, {"q": 1.0}, {"q": 1.0}, {"q": 0.4}, 0.4, (0.3, 0.6))
    assert judge(replace(PREDICTED, missing_terms=(least,), open_loop=(ahead,))).word == "USABLE"
    for other in (replace(least, t=4.9), replace(least, explained=9e-4)):
        assert judge(replace(PREDICTED, missing_terms=(other,))).word == "CALIBRATED"


def test_what_is_usual_is_named_before_a_tilted_base():
    gain, tilt = term("another gain", explained=0.45), term(TILTS[0], explained=0.5, parameter="")
    assert likeliest([tilt, gain]) is gain
    assert likeliest([replace(tilt, explained=0.9), gain]).cause == TILTS[0]
    assert likeliest([]) is None


def test_forces_that_are_not_listed_are_named_where_nothing_listed_explains_nearly_as_much():
    family = term(f"{UNLISTED} (hip), which grows most with its speed", t=12.0, explained=0.5, parameter="")
    drag = term(f"{WEAKENING} (hip)", t=7.5, explained=0.41, parameter="")
    assert missing_term(held(family, drag)) is drag
    assert as_likely(held(family, drag).missing_terms, drag) == []
    weaker, elsewhere = replace(drag, explained=0.39), replace(family, cause=f"{UNLISTED} (knee)", explained=0.45)
    assert missing_term(held(family, weaker)) is family
    assert as_likely(held(family, elsewhere, weaker).missing_terms, family) == [elsewhere]
    sentence = judge(held(family, elsewhere)).sentence
    assert f"the model lacks {family.cause}: a value of 1 ± 0.08 N·m explains 50 %" in sentence
    assert f"{elsewhere.cause} would explain nearly as much; look there for what the model leaves out" in sentence
    assert "add to the spec" not in sentence


def test_drives_that_all_weaken_have_words_in_a_spec():
    sentence = judge(held(term(WEAKENING_ALL, t=7.5, explained=0.26, parameter=""))).sentence
    assert "say so (drive: of their actions, whose back-EMF weakens them)" in sentence
    assert "no parameter of a spec adds it" not in sentence


def test_what_is_uncertain_is_not_missing():
    assert missing_term(held(term(t=4.9))) is None
    assert missing_term(held(term(DRIFT, t=4.9))) is None
    assert missing_term(held(term(DRIFT, t=5.1))) is not None


def test_an_error_of_the_timestep_that_explains_much_has_a_possible_value():
    coarse = term(INTEGRATION, t=20.0, explained=0.4, parameter="")
    assert numerical([coarse]) is coarse
    assert numerical([term(INTEGRATION, t=20.0, explained=0.2)]) is None
    assert numerical([term(INTEGRATION, t=1.9, explained=0.4)]) is None
    assert numerical([replace(coarse, value=3.5)]) is None
    assert numerical([replace(coarse, value=-0.5)]) is None
    delay = term("late actions", t=14.0, explained=0.8)
    assert numerical([coarse, delay]) is None
    assert missing_term(held(coarse, delay)) is delay


def test_terms_that_explain_nearly_as_much_are_as_likely():
    friction, gain = term(explained=0.5), term("another gain", explained=0.45)
    assert as_likely(held(friction, gain, term("a spring", explained=0.3)).missing_terms, friction) == [gain]
    assert as_likely(held(friction, term("another gain", t=4.0, explained=0.5)).missing_terms, friction) == []


def test_a_coarse_integration_step_that_explains_more_is_told_first():
    step, friction = term(INTEGRATION, t=6.0, explained=0.1, parameter=""), term(explained=0.05)
    first = "; first take a smaller timestep of the model, whose error explains 10 % (t = 6.0)"
    assert first in judge(held(step, friction)).sentence
    for terms in ((step, term(explained=0.2)), (replace(step, t=4.0), friction), (replace(step, value=3.5), friction)):
        assert "take a smaller timestep" not in judge(held(*terms)).sentence


def test_a_force_of_two_shapes_is_no_rival_of_itself():
    sine, cosine = (
        term("a drive whose gain depends on where the joint is (hip)", t=t, parameter="") for t in (9.0, 8.0)
    )
    assert as_likely(held(sine, cosine).missing_terms, sine) == []
    assert as_likely(held(sine, term()).missing_terms, sine) == [term()]


def test_a_term_beside_the_error_of_the_timestep_is_named_though_that_explains_more():
    step = replace(term(INTEGRATION, t=20.0, explained=0.4, parameter=""), value=1.0)
    friction = term(t=8.0, explained=0.021)
    assert numerical([step, friction]) == step
    assert missing_term(held(step, friction)) == friction
    # Of a value of 0.5 a half of the error is left; intervals cover the estimate with a term that may be it.
    step, left = replace(step, value=0.5), replace(friction, explained=0.19)
    assert missing_term(held(step, left)) is None and len(of_small_terms([step, left])) == 1
    assert missing_term(held(step, replace(left, explained=0.21))) is not None
    assert missing_term(held(replace(step, t=1.9), left)) == left  # an error that may be chance was not taken away
    assert missing_term(held(replace(step, value=3.0), left)) == left  # nor one of another effect
    assert numerical([replace(step, explained=0.3), term(explained=0.31)]) is None
    assert numerical([replace(step, explained=0.29)]) is None and numerical([replace(step, t=1.9)]) is None
