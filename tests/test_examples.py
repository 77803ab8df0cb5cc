"""The examples run as a user would run them, and say what they should."""

import re
import subprocess
import sys
from pathlib import Path

EXAMPLES = Path(__file__).parent.parent / "examples"


def test_the_spring_is_found():
    ran = subprocess.run(
        [sys.executable, EXAMPLES / "01_spring.py"], capture_output=True, text=True, timeout=280, check=True
    )
    error = re.search(r"([\d.]+) % of range", ran.stdout)
    assert error, ran.stdout
    assert float(error[1]) < 5.0
