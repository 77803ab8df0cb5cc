"""The most memory that this process has held since a moment, where the system tells: on Linux.

A run folder keeps it in a file of its own: unlike the rest of a result it is another one in every run.
"""

import re
from pathlib import Path

from madoc.runs.files import read_json, write_json

PEAK = "memory.json"
"""Name of the file of a run folder that holds `peak_memory`, bytes; not there where it is not known."""

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


def write_peak(folder: Path, peak: int | None) -> None:
    """Keep the peak of a run, bytes, in its folder; None where a part of the run has none that is known."""
    if peak is None:
        (folder / PEAK).unlink(missing_ok=True)
    else:
        write_json(folder / PEAK, {"peak_memory": peak})


def read_peak(folder: Path) -> int | None:
    """The peak of a run, bytes; None where it is not known."""
    file = folder / PEAK
    return int(read_json(file)["peak_memory"]) if file.exists() else None
