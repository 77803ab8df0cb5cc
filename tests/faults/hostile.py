"""What every answer to a stranger's file has to be, and command lines answered one after another in a process."""

import json
import os
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).parents[1]
SECRET = "TOP-SECRET-7261"
SECONDS, MEMORY = 2.0, 1e9
"""Longest time in s and most memory in bytes that an answer may take."""


def answers(lines, **environment):
    """What each of some command lines was answered, by `answering.py` in a process of its own."""
    folders = [str(TESTS.parent / "src"), str(TESTS)]
    process = subprocess.run(
        [sys.executable, str(TESTS / "faults" / "answering.py")],
        input=json.dumps([[str(word) for word in words] for words in lines]),
        env=os.environ | {"PYTHONPATH": os.pathsep.join(folders), "JAX_PLATFORMS": "cpu"} | environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=True,
    )
    return json.loads(process.stdout)


def require_refusal(answer, *words):
    """One sentence, exit code 2, quick and small, that says some words and nothing of the secret file."""
    assert answer["code"] == 2, answer
    said = answer["out"] + answer["err"]
    assert said.startswith(("madoc: ", "fatal: ")), said  # the latter is what `madoc check` finds
    assert said.count("\n") == 1, said
    assert SECRET not in said
    for word in words:
        assert word in said
    assert answer["seconds"] < SECONDS, answer
    assert answer["memory"] is None or answer["memory"] < MEMORY, answer
