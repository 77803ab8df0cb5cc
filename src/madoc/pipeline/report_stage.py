"""The page of a run, left in its folder at the end."""

import warnings
from pathlib import Path

from madoc.report import write_report

PAGE = "report.html"


def leave_report(folder: Path) -> Path | None:
    """Write `report.html` into a run folder; a page that cannot be drawn costs a warning, never the result."""
    try:
        return write_report(folder)
    except Exception as error:  # the result is on the disk already, and worth more than its picture
        warnings.warn(f"no {PAGE} was written into {folder}: {error}", stacklevel=2)
        return None
