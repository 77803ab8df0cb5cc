import os
import re
import subprocess
import sys

import pytest
from command_line import SOURCE

import madoc
from madoc.calibration import CALIBRATORS
from madoc.policies import LEARNERS

README = SOURCE.parent / "README.md"


def loaded_by(code):
    """Which heavy packages some code imports, in a process of its own."""
    program = f"{code}; import sys; print(*({{'jax', 'mujoco', 'equinox', 'rich'}} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"PYTHONPATH": str(SOURCE)},
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stdout.split())


def test_a_robots_computer_needs_numpy_alone():
    assert loaded_by("import madoc; from madoc.numpy_policy import NumpyPolicy") == set()
    without_gymnasium = "import sys; sys.modules['gymnasium'] = None"
    assert loaded_by(f"{without_gymnasium}; import madoc; from madoc.numpy_policy import NumpyPolicy") == set()


def test_the_command_line_starts_without_jax():
    assert "jax" not in loaded_by("import madoc.commands.main")


def test_public_names_are_there():
    assert set(madoc.__all__) <= set(dir(madoc))
    for name in madoc.__all__:
        assert getattr(madoc, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'calibrated'"):
        _ = madoc.calibrated


SMALL = {
    "transitions=20_000": "transitions=500",
}
"""What makes the README's example small enough for a test."""


def test_the_python_of_the_readme_runs(capsys):
    (block,) = re.findall(r"^## In Python\n\n```python\n(.*?)^```$", README.read_text(), re.MULTILINE | re.DOTALL)
    assert sum(bool(line.strip()) for line in block.splitlines()) <= 12
    for before, after in SMALL.items():
        assert block.count(before) == 1, before
        block = block.replace(before, after)
    exec(compile(block, "README.md", "exec"), {})
    told = capsys.readouterr()
    assert told.out.startswith("CALIBRATED: ")
    assert "recording hopper-medium" in told.err  # progress is shown unless it is silenced


def test_every_method_has_its_name_at_the_top():
    for entry in (*CALIBRATORS.values(), *LEARNERS.values()):
        kind = type(entry.make())
        assert getattr(madoc, kind.__name__) is kind
