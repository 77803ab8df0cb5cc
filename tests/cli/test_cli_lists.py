import pytest
from command_line import asked_for_json, start

from madoc.calibration import CALIBRATORS
from madoc.commands.main import main
from madoc.policies import LEARNERS
from madoc.tasks import TASKS


def test_tasks_are_listed(capsys):
    answer, code = asked_for_json(capsys, ["tasks"])
    assert code == 0
    assert [row["name"] for row in answer["tasks"]] == list(TASKS)
    hopper = answer["tasks"][0]
    assert (hopper["observations"], hopper["motors"], len(hopper["parameters"])) == (11, 3, 8)
    assert hopper["parameters"][0] == {
        "name": "gravity",
        "unit": "m/s²",
        "ranges": {"easy": [-15, -5], "normal": [-30, 0], "hard": [-50, 0]},
    }


def test_tasks_as_a_table(capsys):
    assert main(["tasks"]) == 0
    short = capsys.readouterr().out
    assert "halfcheetah" in short
    assert "dof_damping" not in short
    assert main(["tasks", "--verbose"]) == 0
    assert "dof_damping.foot_joint" in capsys.readouterr().out


def test_methods_are_listed(capsys):
    answer, _ = asked_for_json(capsys, ["methods"])
    assert [row["name"] for row in answer["methods"]] == [*CALIBRATORS, *LEARNERS]
    assert all(row["paper"] and row["year"] and row["summary"] for row in answer["methods"])
    assert main(["methods"]) == 0
    told = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in told if line.startswith("│")] == [*CALIBRATORS, *LEARNERS]  # one line each
    assert [line.split(",")[0].strip() for line in told if line[0].isalpha()] == ["calibrators", "policy learners"]


@pytest.mark.parametrize("words", [["--help"], ["calibrate", "--help"]])
def test_help_is_no_mistake(words, capsys):
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code in (0, None)
    assert "usage: madoc" in capsys.readouterr().out


def test_a_reader_that_leaves_early_is_no_bug():
    with start(["methods"]) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 0
