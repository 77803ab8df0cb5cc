"""The measured tables of the README and of the documentation say what the committed results say."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import jax
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import costs
import embedding
import figure_2
import kept
import method_page
import paper
import paper_cells
import pooling
import tables

from madoc.calibration.madoc.agents import initial_actors
from madoc.parameters import Parameter, ParameterSpace

STALE = "stale: run make figures"


def test_the_page_on_methods_says_what_was_measured():
    text = method_page.PAGE.read_text()
    assert text.count("<!-- measured: ") == 1
    assert method_page.rewritten(text) == text, STALE


def test_the_tables_say_what_was_measured():
    assert tables.measured() == tables.PAGE.read_text(), STALE


@pytest.mark.slow
def test_the_papers_tables_say_what_was_measured():
    assert paper.tables() == paper.PAGE.read_text(), STALE


def test_the_picture_of_groups_says_what_was_measured():
    assert embedding.picture(embedding.STUDY.rows()[-1]) == embedding.PICTURE.read_text(), STALE


def test_every_parameter_is_on_the_robot_and_in_the_plane_in_the_colour_of_its_group():
    names = embedding.tasks.make("hopper").parameters.names
    vectors = np.random.default_rng(0).normal(size=(8, 4))
    found = {"groups": [names[:3], names[3:]], "stability": 0.5, "names": names, "vectors": vectors}
    drawn = embedding.picture(found)
    xml = ElementTree.fromstring(drawn)
    points = [each.get("class") for each in xml.iter("{http://www.w3.org/2000/svg}circle")]
    points = [each for each in points if each.startswith("dot")]
    assert (points.count("dot g0"), points.count("dot g1")) == (2 * 3, 2 * 5)
    assert drawn.count(">foot_joint damping<") == 2
    # As the robot stands, its joints are below each other.
    heights = [_height(drawn, f"{joint} damping") for joint in ("thigh_joint", "leg_joint", "foot_joint")]
    assert heights == sorted(heights)


def _height(drawn, name):
    """Pixels below the upper end of the text of a name, where it first stands."""
    return float(re.search(rf'y="([\d.]+)" text-anchor="end">{name}<', drawn)[1])


def test_figure_3b_says_how_many_parameters_and_shares_the_cells_of_all():
    rows = dict.fromkeys(row for row, _ in paper_cells.places("figure-3b-errors"))
    assert list(rows) == ["ant-medium, 1 parameter", *(f"ant-medium, {count} parameters" for count in (2, 4, 8, 12))]
    errors, of_table_10 = (
        {cell.name for cell in paper_cells.planned(name).cells} for name in ("figure-3b-errors", "table-10")
    )
    assert len(errors & of_table_10) == 1 + 3  # the recording, and three methods


@pytest.fixture
def calibrations(tmp_path, monkeypatch):
    """A function that keeps calibrations of hopper-medium for the tables of errors."""
    study = replace(kept.CALIBRATIONS, file=tmp_path / "calibration.jsonl")
    monkeypatch.setattr(paper_cells, "CALIBRATIONS", study)

    def keep(*rows):
        common = {"robot": "hopper", "quality": "medium", "data": "clean", "transitions": 200_000, "budget": 300_000}
        common |= {"commit": "a", "control_steps": 1}
        with study.file.open("a") as lines:
            for method, log, seed, error, other in rows:
                measured = {"mean_absolute": error, "mean_percent_of_range": error}
                row = common | {"method": method, "log": log, "seed": seed, "error": measured} | other
                print(json.dumps(row), file=lines)

    return keep


def test_a_table_of_errors_shows_logs_what_is_printed_and_what_was_not_run(calibrations):
    calibrations(
        ("madoc", 0, 0, 0.1, {}),
        ("madoc", 1, 1, 0.3, {}),
        ("droid", 0, 0, 0.5, {"budget": 1_000_000, "commit": "b"}),
        ("npe", 0, 0, 0.7, {}),
        ("least-squares", 0, 0, 0.9, {"data": "hidden"}),
    )
    told = paper_cells.table_of_errors("table-10")
    assert pooling.OUR_LOGS in told
    header, row = (
        next(line for line in told.splitlines() if line.startswith(f"| {name} |")) for name in ("task", "hopper-medium")
    )
    cells = dict(zip(header.split(" | "), row.split(" | "), strict=True))
    assert cells["madoc"] == "0.2 (2 logs) [0.33 ± 0.06]"
    assert cells["droid"] == "0.5 (1 log, 1,000,000 steps) [0.74 ± 0.29]"
    assert cells["npe"] == "0.7 (1 log)"  # no suite asks for it
    assert cells["least-squares"] == "not run"
    assert cells["commits |"] == "mixed: a, b |"


def test_a_mean_over_tasks_is_of_one_commit(calibrations):
    walker = {"robot": "walker2d"}
    calibrations(("madoc", 0, 0, 0.1, {}), ("madoc", 0, 0, 0.3, walker), ("oted", 0, 0, 0.1, {}))
    calibrations(("oted", 0, 0, 0.3, walker | {"commit": "b"}))
    (last,) = [line for line in paper_cells.table_of_errors("table-10").splitlines() if line.startswith("| mean over")]
    assert "| 0.2 (2 tasks) |" in last
    assert "| several commits |" in last


def test_the_kinds_of_credit_are_compared_over_logs(calibrations):
    robot = {"robot": "halfcheetah"}
    for method, errors in (("madoc", (0.2, 0.2, 0.2)), ("madoc-vdn", (0.1, 0.2, 0.4))):
        calibrations(*((method, log, log, error, robot) for log, error in enumerate(errors)))
    told = paper_cells.table_of_errors("table-12")
    assert "| error over that of madoc (95 % over logs) | | 1.00 (0.18 to 5.59, 3 logs) |  |  | |" in told


def test_a_budget_that_was_run_last_is_shown(calibrations):
    calibrations(("droid", 0, 0, 0.5, {"budget": 1_000_000}), ("droid", 1, 1, 0.1, {}))
    assert paper_cells.error_cell(paper_cells.calibrations("table-10")["hopper-medium", "droid"], None) == "0.1 (1 log)"


def test_returns_show_seeds_refusals_and_what_is_printed():
    values = [{"value": 1.0}, {"value": 3.0}, {}]
    assert paper._returned(values, (76.0, 13.9)) == "2.0 (2 of 3 seeds) [76 ± 13.9]"
    assert paper._returned([{"value": None, "refusal": "no"}], None) == "refuses"
    assert paper._returned([{}], None) == "not run"


@pytest.fixture
def collected(tmp_path, monkeypatch):
    """A function that collects a suite from a folder where some of its cells have left their files: its table."""
    for name, study in paper_cells.STUDIES.items():
        monkeypatch.setitem(paper_cells.STUDIES, name, replace(study, file=tmp_path / f"{name}.jsonl"))
    monkeypatch.setattr(paper, "CALIBRATIONS", replace(kept.CALIBRATIONS, file=tmp_path / "calibration.jsonl"))

    def collect(name, left):
        for cell, files in left:
            folder = cell.folder(tmp_path / "suite")
            folder.mkdir(parents=True)
            for file, text in files.items():
                (folder / file).write_text(text)
        return paper.collect(name, tmp_path / "suite"), paper.table(name)

    return collect


def files_of_a_run(result, count, lines, *, peak=None, fresh=True):
    """The files of a cell, with a line of its log for each (stage, count, seconds)."""
    ending = {"status": "finished", "sentence": "", "seconds": 1.0, "attempts": 1, "host": "", "fresh": fresh}
    log = [{count: spent, "seconds": seconds, "stage": stage, "metrics": {}} for stage, spent, seconds in lines]
    held = {} if peak is None else {"memory.json": json.dumps({"peak_memory": peak})}
    return held | {
        "outcome.json": json.dumps(ending),
        "result.json": json.dumps(result),
        "metrics.jsonl": "".join(json.dumps(line) + "\n" for line in log),
    }


CALIBRATION = {
    **{"method": "madoc", "task": "halfcheetah", "status": "finished", "sentence": "", "control_steps": 2000},
    **{"seconds": 11.0, "seed": 0, "groups": [], "parameters": {}},
}


def test_costs_are_those_of_a_method_by_stage(collected):
    cells = {(cell.kind, cell.asks["method"]): cell for cell in costs.cells(paper_cells.planned("table-3"))}
    assert cells.keys() == {("calibrate", "madoc"), ("learn", "sac"), ("learn", "cql"), ("learn", "morec")}
    of_calibration = [
        ("cloning", 0, 1.0),
        ("grouping", 0, 3.0),
        ("calibrating", 1000, 6.0),
        ("calibrating", 2000, 11.0),
    ]
    of_policy = [("exploring", 500, 1.0), ("learning", 1000, 9.0)]
    of_cql = [("learning", 4000, 6.0), ("learning", 8000, 16.0)]
    left = {
        ("calibrate", "madoc"): files_of_a_run(CALIBRATION, "control_steps", of_calibration, peak=512_000_000),
        ("learn", "sac"): files_of_a_run({"seconds": 10.0}, "control_steps", of_policy, peak=600_000_000, fresh=False),
        ("learn", "cql"): files_of_a_run({"seconds": 16.0}, "updates", of_cql),
    }
    count, told = collected("table-3", [(cells[which], files) for which, files in left.items()])
    assert count == 3 + 1  # and the calibration, beside all others
    assert "9 of 12 cells are not run" in told
    rows = [line for line in told.splitlines() if line.startswith("| ")]
    assert rows[1:4] == [
        "| madoc | 512 | at most 600 [398] |",
        "| cql |  | not known [286] |",
        "| morec |  | not run [1053] |",
    ]
    assert rows[5:] == [
        "| madoc | cloning | 1 | 1 | 1 |  |  |",
        "| madoc | grouping | 2 | 1 | 2 |  | 1.8 s an epoch |",
        "| madoc | calibrating | 8 | 2 | 4 | 4 | 14 s an epoch |",
        "| madoc | exploring | 1 | 1 | 1 | 2 |  |",
        "| madoc | learning | 8 | 1 | 8 | 16 | 4 s an epoch |",
        "| madoc | all | 20 | | | | 5 h |",
        "| cql | learning | 16 | 2 | 8 | 2 | 7 s an epoch |",
        "| cql | all | 16 | | | | 2 h |",
        "| morec | all | not run | | | | 6 h |",
    ]


def test_what_was_collected_once_is_not_read_again(collected, monkeypatch):
    (cell, *others) = paper_cells.wanted(paper_cells.planned("figure-2"))
    found = [{"correlations": {"actors": value, "uniform": -0.5}, "control_steps": 300} for value in (-0.9, -0.7)]
    answers = iter(found)
    monkeypatch.setattr(figure_2, "told", lambda result, folder: next(answers))
    files = files_of_a_run(CALIBRATION, "control_steps", [("calibrating", 1000, 1.0)])
    assert collected("figure-2", [(cell, files)])[0] == 1 + 1
    (row,) = paper.CALIBRATIONS.rows()
    assert (row["robot"], row["quality"], row["data"], row["log"]) == ("halfcheetah", "medium", "clean", "suite 0")
    assert (row["method"], row["seed"], row["control_steps"]) == ("madoc-grouped", 0, 2000)
    count, told = collected("figure-2", [(others[0], files)])
    assert (count, next(answers, None)) == (1 + 1, None)
    assert "| madoc-grouped | drawn from the actors | -0.90 | -0.70 | not run | -0.80 | 300 |" in told
    assert "| madoc-s | uniform over the ranges | not run | not run | not run |  |  |" in told


def test_the_critic_of_gravitys_group_is_correlated_with_gravitys_error():
    """Two groups: one critic knows the error of gravity, the other gets it the wrong way round."""
    space = ParameterSpace((Parameter("body_mass", "torso", 5.0, 7.0), Parameter("gravity", "", -30.0, 0.0)))
    truth = -9.0  # 0.4 of the way from the middle of the range to its end

    def values(draws, members):
        assert members.tolist() == [[False, True], [True, False]]
        error = np.abs(np.asarray(draws)[:, 1] - 0.4)
        return np.stack([-error, error], axis=1)

    agents = SimpleNamespace(actors=initial_actors(2), critics=SimpleNamespace(weight=np.ones(2), values=values))
    state = SimpleNamespace(agents=agents, labels=np.array([1, 0]))
    found = figure_2.correlations(state, space, truth, key=jax.random.key(0))
    assert found == {"actors": -1.0, "uniform": -1.0}
