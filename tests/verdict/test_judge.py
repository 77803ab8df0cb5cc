"""Every verdict from numbers chosen by hand."""

from dataclasses import replace

import numpy as np
import pytest

from madoc.commands.answer import EXIT_CODES
from madoc.verdict import WORDS, judge
from madoc.verdict.assessment import Assessment
from madoc.verdict.judge import explains_all
from madoc.verdict.two_sample import Told

GOOD = Assessment(
    measure="prediction",
    names=("mass", "damping"),
    unit=np.array([0.2, -0.4]),
    relative=0.1,
    relative_interval=(0.08, 0.12),
    best=0.09,
    errors={
        "mid-range": {1: 1.0, 20: 4.0},
        "estimate": {1: 0.1, 20: 0.4},
        "nearby best": {1: 0.1, 20: 0.36},
        "noise": {1: 0.09, 20: 0.35},
    },
    explained=0.02,
    autocorrelation=-0.5,
    shares=np.array([0.01, 0.2]),
    skill=0.9,
    chance=0.008,
    areas={"mid-range": Told(0.9, 0.87, 0.93, 400), "estimate": Told(0.5, 0.46, 0.54, 400)},
    report={},
    control_steps=0,
)
HIDDEN = replace(GOOD, measure="two-sample", errors={}, relative=0.0, best=0.0)
LEFT_OVER = {**GOOD.errors, "nearby best": {1: 0.1, 20: 0.8}}


def test_a_good_estimate_is_calibrated_and_the_sentence_has_its_numbers():
    verdict = judge(GOOD)
    assert verdict.word == "CALIBRATED"
    assert "10 % of mid-range's (95 % interval 8 % to 12 %; 4 → 0.4 after 20 steps" in verdict.sentence
    assert explains_all(GOOD)


@pytest.mark.parametrize(
    ("word", "change", "told"),
    [
        ("DATA_REJECTED", {"skill": 0.05}, "5 % nearer than rows paired at random"),
        ("DATA_REJECTED", {"chance": 0.2}, "p = 0.2"),
        ("MODEL_MISMATCH", {"errors": LEFT_OVER, "explained": 0.6}, "0.8 of a step's change after 20 steps"),
        ("MODEL_MISMATCH", {"errors": LEFT_OVER, "explained": 0.6}, "state and action explain 60 % of it"),
        ("MODEL_MISMATCH", {"errors": LEFT_OVER, "autocorrelation": 0.5}, "correlated from step to step (0.50)"),
        ("MODEL_MISMATCH", {"errors": LEFT_OVER, "unit": np.array([1.0, 0.0])}, "mass at the end of the range"),
        ("NOT_IDENTIFIABLE", {"shares": np.array([0.1, 0.7])}, "leaves damping open"),
        ("NO_IMPROVEMENT", {"relative": 1.1, "relative_interval": (0.9, 1.3)}, "not at its end"),
        ("NO_IMPROVEMENT", {"relative": 0.5, "relative_interval": (0.4, 0.6)}, "parameters nearby leave 9 %"),
        ("NO_IMPROVEMENT", {"best": 0.99, "relative": 1.0}, "mid-range is as good"),
    ],
)
def test_one_thing_wrong_changes_the_word(word, change, told):
    verdict = judge(replace(GOOD, **change))
    assert verdict.word == word
    assert told in verdict.sentence


def test_what_is_left_is_no_mismatch_while_it_looks_like_noise():
    assert judge(replace(GOOD, errors=LEFT_OVER)).word == "CALIBRATED"
    assert not explains_all(replace(GOOD, errors={**GOOD.errors, "estimate": {1: 0.1, 20: 0.8}}))


def test_a_negligible_residual_is_no_mismatch():
    exact = {**GOOD.errors, "nearby best": {1: 1e-5, 20: 9e-4}, "noise": {1: 0.0, 20: 0.0}}
    assert judge(replace(GOOD, errors=exact, explained=1.0)).word == "CALIBRATED"


def test_rejected_data_comes_before_all_else_and_open_parameters_before_no_improvement():
    everything = {"skill": 0.0, "errors": LEFT_OVER, "explained": 0.9, "shares": np.array([1.0, 1.0]), "relative": 2.0}
    assert judge(replace(GOOD, **everything)).word == "DATA_REJECTED"
    assert judge(replace(GOOD, **everything | {"skill": 0.9})).word == "MODEL_MISMATCH"
    verdict = judge(replace(GOOD, shares=np.array([1.0, 1.0]), relative=2.0, relative_interval=(1.9, 2.1)))
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
    areas = {"mid-range": Told(*before, 400), "estimate": Told(*after, 400)}
    assert judge(replace(HIDDEN, areas=areas)).word == word


def test_every_word_has_an_exit_code_of_its_own():
    codes = [EXIT_CODES[word] for word in WORDS]
    assert len(set(codes)) == len(codes)
    assert EXIT_CODES["CALIBRATED"] == 0
    assert not {1, 2, 130} & set(codes)
