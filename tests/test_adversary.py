"""The problems that the adversary puts to the tool: each can be made, its spec is accepted, and answers are counted."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from madoc import robots
from madoc.data import logs

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import adversary
import adversary_table as counted
from adversary_cases import CASES, DECEPTIONS, HONEST, write
from adversary_cases.case import Case, Log, Plant
from adversary_cases.plant import late, truth_of
from adversary_cases.robots import CART
from adversary_cases.write import describe


def short(case):
    return replace(case, log=replace(case.log, runs=len(case.plant.by_run), seconds=0.3))


def answer(case, word, *, miss=0.0, sentence="", check=()):
    return {
        **{"case": case.key, "robot": case.robot.name, "kind": case.kind, "commit": "0", "seconds": 1.0, "seed": 0},
        **{"honest": case.honest, "invisible": case.invisible, "cause": case.cause, "verdict": word, "stopped": False},
        **{"sentence": sentence, "causes": [], "warnings": [], "check": list(check)},
        "parameters": {"friction_elbow": {"miss": miss}},
    }


def test_there_are_enough_cases_and_each_has_a_name_of_its_own():
    assert len(CASES) == len(DECEPTIONS) + len(HONEST)
    assert len(DECEPTIONS) >= 60
    assert len(HONEST) >= 30
    assert len({case.robot.name for case in DECEPTIONS}) >= 5
    assert not any(case.honest for case in DECEPTIONS)
    assert all(case.honest for case in HONEST)


@pytest.mark.parametrize("key", CASES)
def test_every_spec_is_accepted_and_the_calibrated_truth_of_honest_cases_is_within_its_range(key, tmp_path):
    case = CASES[key]
    robot = robots.load(describe(case, tmp_path))
    truth = truth_of(case, 3)
    for parameter in robot.task.parameters.parameters:
        inside = parameter.low <= truth[parameter.name] <= parameter.high
        assert inside or case.kind == "range"


@pytest.mark.parametrize("key", CASES)
def test_every_machine_moves_and_its_log_has_numbers(key, tmp_path):
    problem = write(short(CASES[key]), 0, tmp_path)
    for path in problem.logs.iterdir():
        rows = np.genfromtxt(path, delimiter=",", skip_header=1)
        assert np.isfinite(rows).all()
        assert (np.diff(rows[:, 0]) > 0).all()


def test_the_log_of_an_honest_case_is_read(tmp_path):
    problem = write(CASES["leg.plain"], 0, tmp_path)
    dataset = logs.read(problem.logs, robots.load(problem.spec))
    assert len(dataset.run_names) == CASES["leg.plain"].log.runs


def test_the_same_seed_makes_the_same_log(tmp_path):
    for seed, folder in ((1, "first"), (1, "second"), (2, "other")):
        write(short(CASES["arm.plain"]), seed, tmp_path / folder)
    first, second, other = (
        (tmp_path / folder / "logs" / "run_0.csv").read_text() for folder in ("first", "second", "other")
    )
    assert first == second != other


def test_a_machine_without_additions_is_the_model_itself(tmp_path):
    """A cart whose velocity decays: (1 + h d / m) v' = v, in the implicit integration of MuJoCo."""
    free = {"damping": 0.75, "mass": 1.5, "stiffness": 0.0}
    case = Case(CART, "coasting", Plant(free, limit=0.0, wind=1.0), Log(runs=1, seconds=1.0, noise=0.0))
    write(case, 0, tmp_path)
    rows = np.genfromtxt(tmp_path / "logs" / "run_0.csv", delimiter=",", names=True)
    speed = 0.0
    for _ in range(4):
        speed = (speed + 0.005 / 1.5) / (1 + 0.005 * 0.75 / 1.5)
    assert rows["slide_speed"][1] == pytest.approx(speed, rel=1e-6)


def test_a_delay_of_half_a_row_gives_the_last_command_in_the_first_half():
    commands = [np.array([1.0]), np.array([2.0])]
    assert [late(commands, 0.5 - step / 4)[0] for step in range(4)] == [1.0, 1.0, 2.0, 2.0]
    assert late(commands, 5.0)[0] == 1.0


def test_thirds_of_the_runs_have_a_truth_of_smallest_and_largest_value(tmp_path):
    assert write(short(CASES["pendulum.drift-damping"]), 0, tmp_path).truth["damping"] == (0.15, 0.25)


def test_a_miss_is_a_share_of_the_range():
    row = {"estimate": 0.5, "interval": [0.4, 0.6], "low": 0.0, "high": 2.0}
    assert adversary.compared(row, (0.5, 0.5))["miss"] == 0.0
    assert adversary.compared(row, (0.8, 0.8))["miss"] == pytest.approx(0.1)
    assert adversary.compared(row, (0.3, 0.5))["miss"] == pytest.approx(0.05)
    assert adversary.compared({}, (0.5, 0.5))["miss"] is None


def test_outcomes():
    deception, invisible = CASES["arm.friction-0.2"], CASES["arm.gear-invisible"]
    assert counted.outcome(answer(deception, "CALIBRATED", miss=0.1)) == "false CALIBRATED"
    assert counted.outcome(answer(deception, "CALIBRATED")) == "CALIBRATED"
    assert counted.outcome(answer(deception, "MODEL_MISMATCH", miss=0.1)) == "MODEL_MISMATCH"
    assert counted.outcome(answer(CASES["arm.plain"], "MODEL_MISMATCH")).startswith("false alarm")
    assert counted.outcome(answer(invisible, "CALIBRATED", miss=0.1)) == "unnamed"
    assert counted.outcome(answer(invisible, "CALIBRATED", check=["the gear cannot be told"])) == "CALIBRATED, named"


def test_a_parameter_that_is_named_does_not_name_the_cause():
    case = CASES["arm.friction-0.2"]
    assert not counted.named(answer(case, "MODEL_MISMATCH", sentence="friction_elbow is at 0.2"))
    assert counted.named(answer(case, "MODEL_MISMATCH", sentence="friction_elbow is at 0.2: Coulomb friction"))


def test_the_table_counts():
    results = [
        answer(CASES["arm.friction-0.2"], "CALIBRATED", miss=0.1),
        answer(CASES["arm.friction-0.05"], "CALIBRATED", miss=0.001),
        answer(CASES["arm.plain"], "CALIBRATED"),
    ]
    printed = counted.table(json.loads(json.dumps(results)))
    # deceptions, false ones, near misses, named, refused; invisible; honest, false alarms, refused; intervals that hold
    assert "| 0 | 1 | 2 | 2 | 1 | 0 | 0 | 0 of 0 | 1 | 0 | 0 | 1 of 1 | 0 |" in printed
    assert "| friction | 2 | 2 |" in printed


def test_problems_of_two_commits_are_never_counted_together():
    results = [answer(CASES["arm.plain"], "CALIBRATED") | {"commit": name} for name in "aab"]
    summary = counted.summary(results, fewest=2)
    assert "| a | 1 |" in summary
    assert "| b |" not in summary
    assert summary.endswith("Not shown: 1 problems at 1 commits with few of them.")
    with pytest.raises(ValueError, match="one commit, got those of a, b"):
        counted.table(results)


@pytest.mark.slow
@pytest.mark.parametrize("key", ["pendulum.plain", "cart.plain"])
def test_the_tool_is_run_and_its_answer_kept(key, tmp_path):
    study = replace(adversary.STUDY, file=tmp_path / "adversary.jsonl")
    line = adversary.cell(CASES[key], 0, study=study, revision="0", limit=200.0, check=True)
    (kept,) = study.rows()
    assert key in line
    assert (kept["exit_code"], kept["verdict"]) == (0, "CALIBRATED")
    assert adversary.cell(CASES[key], 0, study=study, revision="0", limit=200.0, check=True) == ""
