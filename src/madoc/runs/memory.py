"""The most memory that this process has held since a moment, where the system tells: on Linux."""

import re
from pathlib import Path

_PROCESS = Path("/proc/self")
_PRESENT_SIZE = "5"
"""What sets the peak of the resident set back to its present size (proc(5), `clear_refs`; Linux 4.0 or later)."""


def forget_peak() -> bool:
    """Look for the peak from now on; whether the system can."""
    try:
        (_PROCESS / "clear_refs").write_text(_PRESENT_SIZE)
    except OSError:
        return False
    return True


def peak_memory() -> int | None:
    """The largest resident set of this process since `forget_peak`, bytes; None where the system does not tell."""
    try:
        told = (_PROCESS / "status").read_text()
    except OSError:
        return None
    peak = re.search(r"^VmHWM:\s+(\d+) kB$", told, re.MULTILINE)
    return None if peak is None else 1024 * int(peak[1])
