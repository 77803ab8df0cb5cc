from pathlib import Path

import pytest

from madoc.calibration.holdout import Verdict
from madoc.calibration.result import CalibrationResult, ParameterEstimate
from madoc.report.page import write_page
from madoc.suites.cells import Cell
from madoc.suites.planning import Plan
from madoc.suites.report import _context
from madoc.suites.results import Result, fleets, ranges
from madoc.suites.standing import Standing


def robot(name, estimate, half=0.0196, word="CALIBRATED", **options):
    order = {"task": "arm.yaml", "source": {"paths": [f"/logs/{name}"]}, "search": {"method": "least-squares"}}
    row = ParameterEstimate(estimate, half / 1.96, 0.0, 2.0, "kg", [estimate - half, estimate + half] if half else None)
    verdict = Verdict(word, "as it is")
    calibration = CalibrationResult(
        *("least-squares", "arm", "converged", "done", 1, 1.0, 0, [["mass"]]), {"mass": row}, verdict=verdict
    )
    cell = Cell(name, "calibrate", order, robot=name)
    return Result(cell, "converged", "done", "least-squares", calibration=calibration, **options)


def test_robots_that_do_not_belong_are_named_and_the_others_share_a_mean():
    estimates = (0.98, 1.0, 1.02, 0.99, 1.01, 1.0)
    results = [robot(f"arm-{n}", value) for n, value in enumerate(estimates)]
    results += [robot("odd", 1.4), robot("wrong", 1.0, word="MODEL_MISMATCH"), robot("bare", 1.0, half=0.0)]
    results.append(Result(Cell("late", "calibrate", results[0].cell.order, robot="late"), "not run"))
    (fleet,) = fleets(results)
    assert set(fleet.left_out) == {"wrong", "bare", "late"}
    assert fleet.left_out["wrong"].startswith("MODEL_MISMATCH: ")
    assert fleet.left_out["bare"] == "least-squares gives no intervals"
    assert fleet.left_out["late"] == "not run"
    (mass,) = fleet.parameters
    assert set(mass.outliers) == {"odd"}
    assert len(mass.robots) == 6
    assert mass.common.mean == pytest.approx(1.0)
    low, high = ranges(fleet)["mass"]
    assert low < 0.98 < 1.02 < high
    assert fleet.to_json()["ranges"] == {"mass": (low, high)}


def test_ranges_stay_within_what_was_searched():
    results = [robot(f"arm-{n}", value) for n, value in enumerate((0.1, 1.0, 1.9))]
    (fleet,) = fleets(results)
    assert ranges(fleet) == {"mass": (0.0, 2.0)}


def test_other_settings_are_another_fleet():
    one, other = robot("arm-1", 1.0), robot("arm-2", 1.0)
    order = {**other.cell.order, "holdout": 0.2}
    changed = Result(Cell("x", "calibrate", order, robot="arm-2"), "not run")
    assert [list(fleet.results) for fleet in fleets([one, other, changed])] == [["arm-1", "arm-2"], ["arm-2"]]


def test_the_page_of_a_fleet_has_a_lane_for_each_robot_and_names_who_does_not_belong(tmp_path):
    results = [robot(f"arm-{n}", value) for n, value in enumerate((0.98, 1.0, 1.02, 0.99, 1.01, 1.4))]
    results.append(robot("wrong", 1.0, word="MODEL_MISMATCH"))
    cells = tuple(result.cell for result in results)
    plan, standing = Plan("fleet", Path("fleet.yaml"), cells), Standing(tmp_path, cells, workers=1)
    write_page(tmp_path / "page.html", "suite.html", _context(plan, standing, results, fleets(results), "again"))
    page = (tmp_path / "page.html").read_text()
    assert page.count('<span class="lane-name">arm-') == 6
    assert "arm-5 <small>p " in page  # the outlier
    assert "<b>wrong</b> MODEL_MISMATCH: as it is" in page
    assert "7 cells were not run" not in page  # these results are given, whatever the empty folder says
