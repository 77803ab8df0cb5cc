"""What was measured and is kept: calibrations and policies, one JSON file each, and how their errors are shown."""

import json
from pathlib import Path

import numpy as np

RESULTS = Path(__file__).parent / "results"


def calibrations() -> list[dict]:
    """Every calibration that was run, refused ones included."""
    rows = [json.loads(path.read_text()) for path in sorted((RESULTS / "calibration").glob("*.json"))]
    return [{"robot": row.get("task"), "data": "clean", "budget": 300_000} | row for row in rows]


def is_time(budget: int | str) -> bool:
    """Whether a budget is a time, as "60s"."""
    return isinstance(budget, str)


def learnt() -> list[dict]:
    """Every policy that was learnt and evaluated."""
    return [json.loads(path.read_text()) for path in sorted((RESULTS / "policies").glob("*.json"))]


def shown(errors: list[float]) -> str:
    """Median (lowest to highest), three decimals or, below them, three digits."""
    median, low, high = np.median(errors), min(errors), max(errors)
    return f"{median:.3f} ({low:.3f} to {high:.3f})" if median >= 1e-3 else f"{median:.1e} ({low:.1e} to {high:.1e})"
