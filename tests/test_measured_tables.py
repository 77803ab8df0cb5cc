"""The measured tables of the README and of the documentation say what the committed results say."""

import json
import re
import sys
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
import paper
import paper_cells
import readme
import tables

from madoc.calibration.madoc.actors import initial_actors
from madoc.parameters import Parameter, ParameterSpace

STALE = "stale: run make figures"


def test_the_readme_says_what_was_measured():
    text = readme.README.read_text()
    assert text.count("<!-- measured: ") == 4
    assert readme.rewritten(text, kept.learnt()) == text, STALE


def test_the_tables_say_what_was_measured():
    assert tables.measured() == (kept.RESULTS / "README.md").read_text(), STALE


@pytest.mark.slow
def test_the_papers_tables_say_what_was_measured():
    assert paper.tables() == (kept.RESULTS / "paper.md").read_text(), STALE


def test_the_picture_of_groups_says_what_was_measured():
    assert embedding.picture(embedding.kept()) == embedding.PICTURE.read_text(), STALE


def test_every_parameter_is_on_the_robot_and_in_the_plane_in_the_colour_of_its_group():
    names = embedding.tasks.make("hopper").parameters.names
    vectors = np.random.default_rng(0).normal(size=(8, 4))
    found = {"groups": [names[:3], names[3:]], "stability": 0.5, "names": names, "vectors": vectors}
    drawn = embedding.picture({"physics": found})
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
    plan = paper.planned("figure-3b-errors")
    rows = dict.fromkeys(score.row for score in paper.scores_of(plan, {}))
    assert list(rows) == ["ant-medium, 1 parameter", *(f"ant-medium, {count} parameters" for count in (2, 4, 8, 12))]
    errors, returns = ({cell.name for cell in each.cells} for each in (plan, paper.planned("figure-3b")))
    assert errors < returns
    of_table_10 = {cell.name for cell in paper.planned("table-10").cells}
    assert len(errors & of_table_10) == 1 + 3 * 3  # the recording, and three methods at three seeds


def test_what_was_measured_is_in_a_table_whatever_options_were_added_since():
    assert set(paper_cells.NO_SCORES) == paper.OWN.keys()
    every = {cell.name for name in paper.TITLES for cell in paper.planned(name).cells}
    assert paper.kept("table-10").keys() <= every


def test_figure_3b_shows_errors_in_percent_of_the_ranges():
    plan = paper.planned("figure-3b-errors")
    cell = next(cell for cell in plan.cells if cell.kind == "calibrate")
    score = paper.scores_of(plan, {cell.name: {"value": 3.0, "percent_of_range": 10.0}})[0]
    assert (score.column, score.value) == ("madoc", 10.0)


def test_agents_are_compared_in_pairs_of_the_same_log_and_seed(monkeypatch):
    tasks = [f"{robot}-medium" for robot in readme.NAMES]
    found = {(task, method): {} for task in tasks for method in readme.COLUMNS}
    found["hopper-medium", "madoc"] = {0: 0.01, 1: 0.02, 5: 0.3}
    found["hopper-medium", "madoc-s"] = {0: 0.02, 1: 0.16}
    for method, error in (("madoc", 0.01), ("madoc-s", 0.04)):
        found["ant-medium", method] = dict.fromkeys(range(4), error)
    found["ant-medium", "madoc-grouped"] = dict.fromkeys(range(5), 0.01)  # too few pairs to be compared
    monkeypatch.setattr(paper, "by_seed", lambda name: found)
    told = readme.errors()
    assert "| Hopper | 0.11 (3 seeds) | not run | 0.09 (2 seeds) | 0.33 | 0.34 |" in told
    assert "| `madoc` against `madoc-s` | 6 | 6 | 0.25 (0.1" in told
    assert "| 0.25 |  |  | 0.25 |" in told  # of Hopper's pairs √(1/2 · 1/8), of Ant's 1/4, and of two robots none
    assert "against `madoc-grouped`" not in told


def test_the_study_compares_agents_by_seed(monkeypatch, tmp_path):
    monkeypatch.setattr(readme, "STUDY", tmp_path)
    errors = {"each": (4.0, 1.0, 1.0), "physics": (2.0, 0.5, 0.4), "one": (7.0,)}
    for groups, found in errors.items():
        for seed, error in enumerate(found):
            row = {"parameters": 12, "draws": 10, "groups": groups, "seed": seed, "error": error}
            (tmp_path / f"{groups}-{seed}.json").write_text(json.dumps(row))
    told = readme.study()
    assert "| parameters | draws an epoch | one agent | groups by physics | one agent a parameter |" in told
    assert "| 12 | 10 | 7.00 (1 seed) | 0.97 (3 seeds): 0.46 (0.34 to 0.64) | 2.00 (3 seeds) |" in told


def test_tasks_that_are_worse_than_printed_are_named(monkeypatch):
    rows = [("a-low", 0.1, 0.2, 1), ("b-low", 0.5, 0.4, 2)]
    monkeypatch.setattr(paper, "beside_printed", lambda column: rows)
    told = readme.tasks()
    assert "On 2 of the paper's 21 tasks, 1 to 2 seeds each, `madoc` errs by 0.3 on average" in told
    assert "where the paper prints 0.30,\nand by no more than printed in 1, all but b-low." in told
    monkeypatch.setattr(paper, "beside_printed", lambda column: rows[:1])
    assert "by no more than printed in each of them." in readme.tasks()


def test_a_cell_shows_seeds_refusals_what_was_not_run_and_what_is_printed():
    def cell(*values, refused=False):
        return [paper.Score("row", "column", value, refused) for value in values]

    assert paper._shown(cell(1.0, 2.0, 6.0), (0.06, 0.01)) == "3 [0.06 ± 0.01]"  # a quarter of 3 is nobody: the mean
    assert paper._shown(cell(2.0, None), None) == "2 (1 of 2 seeds)"
    assert paper._shown(cell(None, None), (1.5, 0.25)) == "not run [1.5 ± 0.25]"
    assert paper._shown(cell(None, None, refused=True), None) == "refuses"


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end():
    assert paper.interquartile_mean(np.array([1.0, 2, 3, 4]), np.array([5.0, 6, 7, 100])) == pytest.approx(4.5)


def test_resampling_stays_within_tasks():
    """Tasks without spread of their own leave no doubt, however far apart they are."""
    low, high = paper.stratified_interval([[1.0, 1.0], [50.0, 50.0], [100.0, 100.0]])
    assert low == high == pytest.approx(50.25)  # of six values one at each end is left out


@pytest.mark.parametrize(("name", "whole"), [("table-3", "table-1"), ("figure-2", "table-10")])
def test_suites_share_their_cells(name, whole):
    """What one table has run the other takes, but for the evaluations that it does not ask for."""
    shared = {cell.name for cell in paper_cells.planned(whole).cells}
    assert {cell.name for cell in paper_cells.planned(name).cells} <= shared


@pytest.fixture
def collected(tmp_path, monkeypatch):
    """A function that collects a suite from a folder where some of its cells have left their files: its table."""
    monkeypatch.setattr(paper_cells, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(paper, "commit", lambda: "0")

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
    cells = {
        (cell.kind, paper_cells.asked(cell)["method"]): cell for cell in costs.cells(paper_cells.planned("table-3"))
    }
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
    assert count == 3
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
    assert collected("figure-2", [(cell, files)])[0] == 1
    count, told = collected("figure-2", [(others[0], files)])
    assert (count, next(answers, None)) == (2, None)
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
