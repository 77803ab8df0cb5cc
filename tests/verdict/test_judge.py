"""Every verdict from numbers chosen by hand."""

from dataclasses import replace
from typing import get_args

import pytest

from madoc.calibration.holdout import (
    AgainstChance,
    Area,
    Fitted,
    OpenLoop,
    Predicted,
    PredictionError,
    PredictionErrors,
    RicherModel,
    ToldApart,
)
from madoc.commands.answer import EXIT_CODES
from madoc.identification.causes import INTEGRATION
from madoc.identification.term_tests import MissingTerm
from madoc.verdict import Word, judge
from madoc.verdict.judge import beats_mid_range, explains_all


def errors(one, twenty):
    return tuple(PredictionError(steps, mean, (mean, mean)) for steps, mean in ((1, one), (20, twenty)))


COMMON = {
    "split": "1 of 5 episodes is held out",
    "rows": 400,
    "episodes": 1,
    "estimate": {"mass": 0.2, "damping": -0.4},
    "values": {"mass": (1.2, 0.01, "kg"), "damping": (0.6, 0.2, "1")},
    "interval_shares": {"mass": 0.01, "damping": 0.2},
    "against_chance": (AgainstChance("the simulator", 0.9, 0.002), AgainstChance("staying in place", 0.2, 0.01)),
    "noise": {"q": 0.1},
    "control_steps": 0,
}
ERRORS = PredictionErrors(
    mid_range=errors(1.0, 4.0),
    estimate=errors(0.1, 0.4),
    nearby_best=errors(0.1, 0.36),
    noise=errors(0.09, 0.35),
    relative=0.1,
    relative_interval=(0.08, 0.12),
    nearby_relative=0.09,
    windows=400,
)
BEFORE, AFTER = Area(0.9, (0.87, 0.93), 400), Area(0.5, (0.46, 0.54), 400)
PREDICTED = Predicted(**COMMON, errors=ERRORS)
FITTED = Fitted(**COMMON, errors=ERRORS)
TOLD_APART = ToldApart(**COMMON, area_at_mid_range=BEFORE, area_at_estimate=AFTER)
EITHER = pytest.mark.parametrize("good", [PREDICTED, FITTED])
LEFT_OVER = {"nearby_best": errors(0.1, 0.8)}


DRAG = MissingTerm("drag", "dof_drag.hip", 0.1, 0.01, "1", 0.8, 10.0, {"mass": 0.7})


def lacking(good, **changes):
    """A hold-out whose errors are beyond those of noise, and of which a term explains most."""
    return changed(good, LEFT_OVER, **{"missing_terms": (DRAG,)} | changes)


def changed(good, error_changes=None, **changes):
    """A hold-out with other numbers: those of its errors, then its own."""
    return replace(good, errors=replace(good.errors, **(error_changes or {})), **changes)


@EITHER
def test_a_good_estimate_is_calibrated_and_the_sentence_has_its_numbers(good):
    verdict = judge(good)
    assert verdict.word == "CALIBRATED"
    told = "10 % of mid-range's (95 % interval 8 % to 12 %; mid-range errs by 4 and the estimate by 0.4 of what"
    assert told in verdict.sentence
    assert explains_all(good)


@EITHER
@pytest.mark.parametrize(
    ("word", "of_errors", "change", "told"),
    [
        ("DATA_REJECTED", {}, {"against_chance": (AgainstChance("s", 0.05, 0.002),)}, "5 % nearer than rows paired"),
        ("DATA_REJECTED", {}, {"against_chance": (AgainstChance("s", 0.9, 0.2),)}, "p = 0.2"),
        ("MODEL_MISMATCH", LEFT_OVER, {"at_end": ("mass",)}, "mass at the end of the range"),
        ("NOT_IDENTIFIABLE", {}, {"interval_shares": {"mass": 0.1, "damping": 0.7}}, "leaves damping open"),
        ("NO_IMPROVEMENT", {"relative": 1.1, "relative_interval": (0.9, 1.3)}, {}, "not at its end"),
        ("NO_IMPROVEMENT", {"relative": 0.5, "relative_interval": (0.4, 0.6)}, {}, "parameters nearby leave 9 %"),
        (
            "NO_IMPROVEMENT",
            {"nearby_relative": 0.99, "relative": 1.0, "relative_interval": (0.98, 1.02)},
            {},
            "mid-range is as good",
        ),
    ],
)
def test_one_thing_wrong_changes_the_word(good, word, of_errors, change, told):
    verdict = judge(changed(good, of_errors, **change))
    assert verdict.word == word
    assert told.replace("actions?", "action" if good is PREDICTED else "actions") in verdict.sentence


def test_a_certain_term_is_a_mismatch_though_it_hardly_moves_the_estimate():
    offset = MissingTerm("an offset of the sensor", "signal_bias.hip", 0.1, 0.01, "1", 0.8, 10.0, {"mass": 0.1})
    richer = RicherModel("signal_bias.hip", ())
    verdict = judge(replace(PREDICTED, missing_terms=(offset,), richer=richer))
    assert verdict.word == "MODEL_MISMATCH"
    assert "the model lacks an offset of the sensor (signal_bias.hip): a value of 0.1 ± 0.01" in verdict.sentence
    assert "(t = 10.0), and would move mass by +0.001 from 1.2 kg; a model with it explains the log" in verdict.sentence
    assert verdict.sentence.endswith("{field: signal_bias, element: hip, low: 0, high: 0.2}")


def predicted_over(seconds, relative, interval, *, whole=False, windows=60):
    return OpenLoop(seconds, whole, windows, {"q": 1.0}, {"q": 1.0}, {"q": relative}, relative, interval)


@EITHER
@pytest.mark.parametrize(("whole", "ratio", "less"), [(True, 2.1, 1.9), (False, 1.4, 1.2)])
def test_predictions_that_noise_and_uncertainty_do_not_explain_are_never_calibrated(good, whole, ratio, less):
    far = replace(predicted_over(1.0, 0.4, (0.3, 0.6), whole=whole), beside_noise={"q": 1.0, "qd": ratio})
    verdict = judge(replace(good, open_loop=(far,)))
    assert verdict.word == "USABLE" and f"1 s it predicts qd with {ratio} times the error, at least" in verdict.sentence
    near = replace(far, beside_noise={"qd": less}), replace(far, windows=3)
    assert judge(replace(good, open_loop=near)).word == "CALIBRATED"


@EITHER
def test_what_predicts_much_better_than_the_model_as_given_is_usable_though_the_model_lacks_something(good):
    wrong = lacking(good)
    over = (
        predicted_over(0.1, 0.9, (0.8, 1.1)),
        predicted_over(1.0, 0.4, (0.3, 0.6)),
        predicted_over(6.0, 2.0, (1, 3), whole=True),
    )
    others = replace(over[1], as_given={"q": 1.0, "qd": 1.0, "yaw": 1.0}, estimate={"q": 0.4, "qd": 1.05, "yaw": 1.2})
    worse = judge(replace(wrong, open_loop=(over[0], others))).sentence
    assert "(95 % interval 30 % to 60 %; yaw is predicted worse than by that model), so" in worse
    quiet = judge(replace(wrong, open_loop=(over[0], others), noise={"yaw": 1.3})).sentence
    assert "(95 % interval 30 % to 60 %), so" in quiet
    word, sentence = (verdict := judge(replace(wrong, open_loop=over))).word, verdict.sentence
    told = "over 1 s held-out motion is predicted with 40 % of the error of the model as given (95 % interval 30 % to "
    assert word == "USABLE" and sentence.startswith(told)
    assert "need not be the machine's own values, as what the model lacks acts like drag (dof_drag.hip)" in sentence


@EITHER
@pytest.mark.parametrize(
    ("relative", "interval", "change"),
    [
        (0.85, (0.8, 0.9), {}),
        (0.7, (0.4, 1.01), {}),
        (0.4, (0.3, 0.6), {"at_end": ("mass",)}),
        (0.4, (0.3, 0.6), {"contradictions": ("actions come late",)}),
    ],
)
def test_what_is_hardly_better_at_an_end_or_contradicted_stays_a_mismatch(good, relative, interval, change):
    wrong = lacking(good, open_loop=(predicted_over(1.0, relative, interval),), **change)
    assert judge(wrong).word == "MODEL_MISMATCH"
    assert judge(replace(wrong, open_loop=())).word == "MODEL_MISMATCH"


def test_an_estimate_that_makes_up_for_what_the_model_lacks_is_never_calibrated():
    over = (predicted_over(1.0, 0.4, (0.3, 0.6)),)
    verdict = judge(replace(PREDICTED, open_loop=over), effective=True)
    assert verdict.word == "USABLE" and "leaves more than noise" in verdict.sentence
    assert judge(PREDICTED, effective=True).word == "NOT_IDENTIFIABLE"


def test_what_predicts_certainly_worse_over_another_time_stays_a_mismatch():
    over = (predicted_over(0.1, 0.4, (0.3, 0.6)), predicted_over(1.0, 1.5, (1.2, 1.8)))
    assert judge(lacking(PREDICTED, open_loop=over)).word == "MODEL_MISMATCH"


def test_a_few_windows_show_nothing():
    few = predicted_over(1.0, 0.4, (0.4, 0.4), windows=4)
    assert judge(lacking(PREDICTED, open_loop=(few,))).word == "MODEL_MISMATCH"


def test_a_search_that_has_not_settled_is_never_usable():
    wrong = lacking(PREDICTED, open_loop=(predicted_over(1.0, 0.4, (0.3, 0.6)),))
    assert judge(wrong, settled=False).word == "MODEL_MISMATCH"


@EITHER
def test_a_log_that_contradicts_the_spec_is_a_mismatch_however_well_it_is_predicted(good):
    said = judge(changed(good, contradictions=("torque: it comes 1.2 rows late; add a delay",)))
    assert (said.word, said.sentence) == (
        "MODEL_MISMATCH",
        "the log contradicts the spec: torque: it comes 1.2 rows late; add a delay",
    )


@EITHER
def test_an_end_of_a_range_says_nothing_while_the_search_has_not_settled(good):
    at_end = replace(good, at_end=("mass",))
    assert judge(at_end).word == "MODEL_MISMATCH"
    unsettled = judge(at_end, settled=False)
    assert unsettled.word == "NO_IMPROVEMENT" and "had not settled" in unsettled.sentence
    # Errors beyond noise are a mismatch from fitted starts; replays from logged states may have random forces in them.
    word = "NO_IMPROVEMENT" if good is PREDICTED else "MODEL_MISMATCH"
    assert judge(changed(at_end, LEFT_OVER), settled=False).word == word


@EITHER
def test_a_search_that_has_not_settled_is_of_use_where_it_predicts_much_better(good):
    over = (predicted_over(1.0, 0.1, (0.08, 0.12)),)
    said = judge(replace(good, open_loop=over), settled=False)
    assert said.word == "USABLE" and "the search had not settled" in said.sentence
    open_ended = replace(good, open_loop=over, interval_shares=dict.fromkeys(good.interval_shares, 0.9))
    assert judge(open_ended).word == "NOT_IDENTIFIABLE" and judge(open_ended, settled=False) == said
    assert judge(replace(good, open_loop=over, at_end=("mass",)), settled=False) == said
    for open_loop in ((), (*over, predicted_over(0.1, 1.5, (1.2, 1.8)))):
        assert judge(replace(good, open_loop=open_loop), settled=False).word == "NO_IMPROVEMENT"


def test_errors_behind_a_fitted_start_are_said_to_be():
    verdict = judge(changed(FITTED, LEFT_OVER))
    assert verdict.word == "MODEL_MISMATCH"
    assert "after 20 rows from a fitted start even" in verdict.sentence
    assert "that fit the hold-out best err by 0.8 of what a signal" in verdict.sentence


def test_what_is_left_is_no_mismatch_while_it_looks_like_random_forces():
    assert judge(changed(PREDICTED, LEFT_OVER)).word == "CALIBRATED"
    assert not explains_all(changed(PREDICTED, {"estimate": errors(0.1, 0.8)}))
    # Where starts are fitted nothing tells random forces from what the model lacks.
    told = judge(changed(FITTED, LEFT_OVER))
    assert told.word == "MODEL_MISMATCH" and "times as much as noise does (mid-range" in told.sentence


def test_errors_count_as_the_timesteps_only_if_they_were_measured_with_it():
    """Friction explains too little to be named where the timestep, or nothing far beyond noise, makes the errors."""
    small = MissingTerm("friction", "friction", 0.1, 0.01, "1", 0.004, 6.0, {"mass": 0.1})
    step = MissingTerm(INTEGRATION, "", 1.0, 0.1, "1", 0.4, 9.0, {"mass": 0.2})
    for good in (PREDICTED, FITTED):
        left = changed(good, LEFT_OVER | {"estimate": errors(0.1, 0.8)})
        own = replace(left, missing_terms=(step, small))
        assert judge(own).word == "CALIBRATED" and explains_all(own)
        finer = replace(
            own, timestep_of_tests="longer"
        )  # the errors have no error of the own timestep, which was tested
        assert judge(finer).word == "MODEL_MISMATCH" and not explains_all(finer)
        shorter = replace(left, timestep_of_tests="shorter")
        assert judge(shorter).word == "CALIBRATED" and explains_all(shorter)
        assert judge(replace(left, missing_terms=(small,))).word == "MODEL_MISMATCH"
        assert judge(replace(shorter, missing_terms=(small,))).word == "NOT_IDENTIFIABLE"  # it is certain


@EITHER
def test_a_negligible_residual_is_no_mismatch(good):
    exact = {"nearby_best": errors(1e-5, 9e-4), "noise": errors(0.0, 0.0)}
    assert judge(changed(good, exact)).word == "CALIBRATED"


@EITHER
def test_rejected_data_comes_before_all_else_and_open_parameters_before_no_improvement(good):
    poor = changed(good, {"relative": 2.0, "relative_interval": (1.9, 2.1)})
    wide = {"interval_shares": {"mass": 1.0, "damping": 1.0}}
    chance = (AgainstChance("s", 0.0, 0.5),)
    assert judge(lacking(poor, **wide, against_chance=chance)).word == "DATA_REJECTED"
    assert judge(lacking(poor, **wide)).word == "MODEL_MISMATCH"
    verdict = judge(replace(poor, **wide))
    assert (verdict.word, verdict.parameters) == ("NOT_IDENTIFIABLE", ("mass", "damping"))


@pytest.mark.parametrize(
    ("word", "before", "after"),
    [
        ("CALIBRATED", (0.9, 0.87, 0.93), (0.55, 0.51, 0.59)),
        ("MODEL_MISMATCH", (0.99, 0.98, 1.0), (0.8, 0.76, 0.84)),
        ("NO_IMPROVEMENT", (0.8, 0.76, 0.84), (0.9, 0.87, 0.93)),
        ("NO_IMPROVEMENT", (0.56, 0.52, 0.60), (0.55, 0.52, 0.58)),
    ],
)
def test_rows_alone_are_judged_by_the_classifier(word, before, after):
    at_mid_range, at_estimate = (Area(area, tuple(ends), 400) for area, *ends in (before, after))
    assert judge(replace(TOLD_APART, area_at_mid_range=at_mid_range, area_at_estimate=at_estimate)).word == word


@pytest.mark.parametrize("good", [PREDICTED, FITTED, TOLD_APART])
def test_what_could_not_be_tested_or_stands_at_an_end_is_not_calibrated(good):
    why = "the log tells no states" if good is TOLD_APART else "whether the model lacks anything was not tested"
    untested, useful = replace(good, tested=False), {"open_loop": (predicted_over(1.0, 0.4, (0.3, 0.6)),)}
    assert judge(untested).word == "NOT_IDENTIFIABLE" and f", but {why}" in judge(untested).sentence
    assert good is TOLD_APART or judge(replace(untested, **useful)).word == "USABLE"
    hurried = judge(untested, in_time=False).sentence
    assert good is TOLD_APART or ("as the budget left no time" in hurried and "log more" not in hurried)
    assert judge(replace(good, at_end=("mass",))).word == "MODEL_MISMATCH"
    wide = replace(good, interval_shares={"mass": 0.9, "damping": 0.2}, **useful)
    few = judge(replace(wide, open_in_time=("mass",)))
    assert judge(wide).word == "NOT_IDENTIFIABLE" and "give it a larger budget" in few.sentence
    assert good is TOLD_APART or few.word == "USABLE"


@EITHER
def test_residuals_with_long_tails_are_a_mismatch(good):
    verdict = judge(good, unlike_noise=True)
    assert verdict.word == "MODEL_MISMATCH" and verdict.sentence.startswith("residuals are unlike noise")


@EITHER
def test_a_right_guess_is_confirmed_where_intervals_hold_it(good):
    no_gain = {
        "mid_range": errors(0.1, 0.4),
        "relative": 1.0,
        "relative_interval": (0.98, 1.02),
        "nearby_relative": 0.99,
    }
    near = {"mass": 0.005, "damping": -0.1}
    verdict = judge(changed(good, no_gain, estimate=near))
    assert verdict.word == "CALIBRATED"
    assert "is 100 % of mid-range's" in verdict.sentence and "mid-range is confirmed" in verdict.sentence
    assert judge(changed(good, no_gain)).word == "NO_IMPROVEMENT"  # 0.2 is 20 half-widths from mid-range
    loud = no_gain | {"mid_range": errors(0.1, 0.8)}
    assert judge(changed(good, loud, estimate=near)).word == "NO_IMPROVEMENT"
    stuck = no_gain | {"nearby_relative": 0.5}
    assert judge(changed(good, stuck, estimate={"mass": 0.0, "damping": 0.0})).word == "NO_IMPROVEMENT"


@EITHER
def test_a_small_gain_counts_where_it_is_significant_and_the_rest_is_noise(good):
    interval = {"relative_interval": (0.95, 0.99)}
    gain = {"mid_range": errors(0.1, 0.41), "relative": 0.97, "nearby_relative": 0.97} | interval
    assert judge(changed(good, gain)).word == "CALIBRATED"
    assert judge(changed(good, gain | {"relative_interval": (0.94, 1.01)})).word == "NO_IMPROVEMENT"
    few = judge(changed(good, gain | {"relative_interval": (0.94, 1.01), "windows": 10}))
    assert few.word == "NO_IMPROVEMENT" and "the 10 windows" in few.sentence
    left = errors(0.3, 1.2)
    loud = gain | {"estimate": left, "nearby_best": left, "mid_range": errors(0.3, 1.23)}
    assert judge(changed(good, loud)).word == ("NO_IMPROVEMENT" if good is PREDICTED else "MODEL_MISMATCH")


@EITHER
def test_a_gain_that_noise_hides_within_a_few_rows_counts_over_a_longer_time(good):
    hidden = changed(good, {"relative": 0.97, "nearby_relative": 0.97, "relative_interval": (0.94, 1.01)})
    assert judge(hidden).word == "NO_IMPROVEMENT"
    assert judge(replace(hidden, open_loop=(predicted_over(1.0, 0.2, (0.1, 0.3)),))).word == "CALIBRATED"
    for less in (predicted_over(1.0, 0.5, (0.4, 0.6)), predicted_over(1.0, 0.2, (0.2, 0.2), windows=4)):
        assert judge(replace(hidden, open_loop=(less,))).word == "NO_IMPROVEMENT"
    better = (predicted_over(1.0, 0.2, (0.1, 0.3)),)
    for worse in ({"relative": 1.3, "relative_interval": (1.2, 1.4)}, {"nearby_relative": 0.5}):
        assert judge(replace(changed(hidden, worse), open_loop=better)).word == "NO_IMPROVEMENT"
    still = replace(better[0], estimate={"q": 1.0, "w": 0.0}, mid_range={"q": 1.0, "w": 0.0})
    assert judge(replace(hidden, open_loop=(still,))).word == "NO_IMPROVEMENT"
    assert judge(replace(hidden, open_loop=(*better, predicted_over(0.1, 2.0, (1.5, 3.0))))).word == "NO_IMPROVEMENT"


@EITHER
def test_a_gain_that_few_windows_do_not_show_for_certain_counts_where_predictions_are_much_better(good):
    uncertain = changed(good, {"relative": 0.86, "nearby_relative": 0.86, "relative_interval": (0.7, 1.01)})
    much = predicted_over(1.0, 0.8, (0.7, 0.9))
    assert judge(uncertain).word == "NO_IMPROVEMENT"
    assert judge(replace(uncertain, open_loop=(much,))).word == "CALIBRATED"
    for less in (
        (predicted_over(1.0, 0.85, (0.8, 0.9)),),
        (predicted_over(1.0, 0.8, (0.6, 1.0)),),
        (replace(much, windows=4),),
        (much, predicted_over(0.1, 1.3, (1.1, 1.5))),
    ):
        assert judge(replace(uncertain, open_loop=less)).word == "NO_IMPROVEMENT"


@EITHER
def test_a_sentence_names_three_other_terms_at_most(good):
    terms = tuple(
        MissingTerm("Coulomb friction", f"dof_frictionloss.j{joint}", 0.1, 0.01, "N·m", 0.3, 9.0, {"mass": 2.0})
        for joint in range(6)
    )
    verdict = judge(changed(good, missing_terms=terms))
    assert verdict.word == "MODEL_MISMATCH"
    assert verdict.sentence.count(" or Coulomb friction") == 2


def test_every_word_has_an_exit_code_of_its_own():
    codes = [EXIT_CODES[word] for word in get_args(Word)]
    assert len(set(codes)) == len(codes)
    assert EXIT_CODES["CALIBRATED"] == 0
    assert not {1, 2, 130} & set(codes)


def test_an_estimate_beats_mid_range_beyond_chance():
    assert all(beats_mid_range(good) for good in (PREDICTED, FITTED, TOLD_APART))
    assert not beats_mid_range(changed(FITTED, {"relative": 0.9, "relative_interval": (0.7, 1.1)}))
    assert not beats_mid_range(replace(TOLD_APART, area_at_estimate=Area(0.88, (0.85, 0.91), 400)))
