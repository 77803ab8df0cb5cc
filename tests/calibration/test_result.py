import json
from dataclasses import replace

import numpy as np
import pytest
from test_holdout import REPORTS

from madoc.calibration import CalibrationResult, ParameterEstimate
from madoc.errors import MadocError


def result(**changes):
    parameters = {
        "gravity": ParameterEstimate(-9.81, 0.02, -30.0, 0.0, "m/s²", [-9.85, -9.77]),
        "body_mass.foot": ParameterEstimate(5.0, 0.1, 4.0, 6.0, "kg"),
    }
    told = {"covariance": np.diag([4e-4, 1e-2]).tolist(), "groups": [["gravity", "body_mass.foot"]]}
    return CalibrationResult(
        "m", "hopper", "finished", "done", 1, 0.0, 0, **{"parameters": parameters} | told | changes
    )


def test_what_is_known_of_the_spread_is_kept():
    told = json.loads(json.dumps(result().to_json()))
    assert told["covariance"] == [[4e-4, 0.0], [0.0, 1e-2]]
    assert told["parameters"]["gravity"]["interval"] == [-9.85, -9.77]
    assert CalibrationResult.from_json(told) == result()


def test_what_is_not_known_is_left_out():
    told = result(covariance=None).to_json()
    assert "covariance" not in told
    assert "error" not in told
    assert "interval" not in told["parameters"]["body_mass.foot"]
    assert CalibrationResult.from_json(told).covariance is None


def test_values_of_the_model_as_given_have_a_column_where_they_are_known():
    assert "as given" not in str(result())
    rows = result().parameters
    given = result(parameters=rows | {"body_mass.foot": replace(rows["body_mass.foot"], given=4.5)})
    assert "as given" in str(given) and "4.5" in str(given)
    assert CalibrationResult.from_json(json.loads(json.dumps(given.to_json()))) == given


def test_half_a_width_reaches_to_the_end_that_is_not_cut_off():
    cut_off = ParameterEstimate(0.1, 0.3, 0.0, 2.0, "kg", [0.0, 0.7])
    assert cut_off.half_width == pytest.approx(0.6)
    assert ParameterEstimate(1.0, 0.1, 0.0, 2.0, "kg").half_width == pytest.approx(0.196, rel=1e-3)
    widened = result(parameters={"mass": cut_off}).with_intervals({"mass": (0.5, 0.5)}, "widened")
    assert widened.parameters["mass"].interval == pytest.approx([0.0, 1.0])


def test_intervals_have_a_column_of_their_own():
    assert "[-9.850, -9.770]" in str(result())


@pytest.mark.parametrize("report", REPORTS)
def test_the_record_of_the_hold_out_comes_back_as_it_was(report):
    stored = json.loads(json.dumps(result(holdout=report).to_json()))
    assert CalibrationResult.from_json(stored).holdout == report


def test_why_auto_took_a_method_is_kept_and_told():
    why = "auto took madoc: least-squares refuses: rows are shuffled"
    told = result(chosen=why)
    assert CalibrationResult.from_json(told.to_json()) == told
    assert why in str(told)
    assert "chosen" not in result().to_json()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"holdout": {"measure": "prediction", "relative": 0.1}},
            r"by this version of Madoc \(holdout: .*calibrate again, or delete its entry holdout",
        ),
        ({"spent": 3}, r"\(spent: Unexpected keyword argument\); calibrate again$"),
        ({"parameters": {"gravity": {"std": 1.0}}}, r"\(parameters.gravity.estimate: Field required\)"),
    ],
)
def test_another_file_is_refused_in_a_sentence(changes, sentence):
    with pytest.raises(MadocError, match=sentence):
        CalibrationResult.from_json(result().to_json() | changes)
