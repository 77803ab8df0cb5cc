"""The records of what a hold-out shows of an estimate."""

from dataclasses import replace

import pytest

from madoc.calibration.holdout import (
    AgainstChance,
    Area,
    Fitted,
    OpenLoop,
    Predicted,
    PredictionError,
    PredictionErrors,
    ToldApart,
)

COMMON = {
    "split": "1 of 5 episodes is held out",
    "rows": 400,
    "episodes": 1,
    "estimate": {"mass": 0.2},
    "values": {"mass": (1.2, 0.02, "kg")},
    "interval_shares": {"mass": 0.01},
    "against_chance": (AgainstChance("the simulator", 0.9, 0.02), AgainstChance("staying in place", 0.2, 0.002)),
    "noise": {"q": 0.1},
    "control_steps": 7,
}
ROW = (PredictionError(1, 0.1, (0.05, 0.2)),)
ERRORS = PredictionErrors(ROW, ROW, ROW, ROW, 0.1, (0.08, 0.12), 0.09, 400)
AREA = Area(0.7, (0.6, 0.8), 400)
REPORTS = [
    Predicted(**COMMON, errors=ERRORS),
    Fitted(**COMMON, errors=ERRORS),
    ToldApart(**COMMON, area_at_mid_range=AREA, area_at_estimate=AREA),
]


def test_the_clearest_prediction_pays_for_the_others_that_were_tried():
    assert (REPORTS[0].clearest.prediction, REPORTS[0].chance) == ("staying in place", 0.004)


@pytest.mark.parametrize(("report", "score"), [*zip(REPORTS, (0.1, 0.1, pytest.approx(0.2)), strict=True)])
def test_less_is_better_by_every_measure(report, score):
    assert report.score == score
    assert report.score_interval[0] < report.score < report.score_interval[1]


def test_what_is_told_is_the_longest_time_over_which_the_model_as_given_is_beaten_for_certain():
    def over(seconds, relative, high, *, whole=False):
        errors = {"q": 1.0}
        return OpenLoop(seconds, whole, 60, errors, errors, errors, relative, (relative, high))

    short, middle, long = over(0.1, 0.1, 0.2), over(0.3, 0.15, 0.3), over(1.0, 0.92, 1.3)
    given = replace(REPORTS[1], open_loop=(short, middle, long, over(9.0, 0.1, 0.2, whole=True)))
    assert given.ahead == middle
    assert replace(given, open_loop=(over(0.3, 0.9, 1.1), long)).ahead == long
    assert replace(given, open_loop=(over(1.0, 1.1, 1.3),)).ahead is None
