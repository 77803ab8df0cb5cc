"""What the command line does of itself, whatever the command."""

import pytest

from madoc.commands.main import main


@pytest.mark.parametrize("line", ["report ~nosuchuser/run", "record hopper-medium --out ~nosuchuser/log.npz"])
def test_the_home_of_a_user_that_is_not_there_is_one_sentence(line, capsys):
    assert main(line.split()) == 2
    sentence = "madoc: a path begins with ~ and the name of no user of this machine; write the folder out\n"
    assert capsys.readouterr().err == sentence


def test_other_errors_are_not_taken_for_that(monkeypatch):
    def broken(self):
        raise RuntimeError("out of memory")

    monkeypatch.setattr("madoc.commands.lists.Tasks.run", broken)
    with pytest.raises(RuntimeError, match="out of memory"):
        main(["tasks"])
