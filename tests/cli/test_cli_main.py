"""What the command line does of itself, whatever the command."""

import io
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata

import pytest
from command_line import SOURCE

import madoc
from madoc.commands.answer import Answer
from madoc.commands.main import _one_sentence, main


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


def test_letters_that_a_terminal_lacks_are_shown_as_numbers(monkeypatch):
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="ascii"))
    monkeypatch.setattr("madoc.commands.lists.Tasks.run", lambda self: Answer({"unit": "µ°"}, ("µ°",)))
    assert main(["tasks"]) == 0
    assert main(["tasks", "--json"]) == 0
    text, answer = written.getvalue().splitlines()
    assert text == rb"\xb5\xb0"
    assert json.loads(answer) == {"unit": "µ°"}


def test_a_box_of_ascii_is_one_sentence_as_well():
    rule = "-" * 40
    lines = ["Parsing error", "Unrecognized options:", "--budgt", rule, "Perhaps you meant:", "--budget", rule]
    box = "\n".join([*lines, "For full helptext, run:", "madoc calibrate --help", " \n"])
    told = "Unrecognized options: --budgt; Perhaps you meant: --budget; see madoc calibrate --help"
    assert _one_sentence(box) == told
    assert _one_sentence(box.replace("-" * 10, "─" * 10)) == told


def test_the_version_is_that_of_the_package(capsys):
    assert main(["--version"]) == 0
    installed = metadata.version("madoc-calibration")
    assert madoc.__version__ == installed
    told = capsys.readouterr().out
    assert told.startswith(f"madoc {installed} (python 3.")
    assert f"jax {metadata.version('jax')}" in told


def test_files_without_their_package_have_no_version(tmp_path):
    shutil.copytree(SOURCE / "madoc", tmp_path / "madoc", ignore=shutil.ignore_patterns("__pycache__"))
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    words = [sys.executable, "-S", "-c", "import madoc; print(madoc.__version__)"]  # -S: without site-packages
    done = subprocess.run(words, cwd=tmp_path, env=plain, capture_output=True, text=True, check=True)
    assert done.stdout == "unknown\n"


def test_the_changelog_begins_with_this_version():
    project = tomllib.loads((SOURCE.parent / "pyproject.toml").read_text())["project"]
    first, *_ = re.findall(r"^## (\S+)", (SOURCE.parent / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert first == project["version"]
