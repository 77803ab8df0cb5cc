"""The table of calibration methods under disturbances of the data, each with the same wall time."""

from collections import defaultdict

import numpy as np
from kept import calibrations, is_time, shown

from calibration import usual_starts

DISTURBED = ("noise-1", "noise-10", "modern", "friction-20", "hidden", "shuffled-rows", "shuffled-next")


def disturbed() -> str:
    """Error of every method on every kind of data with the same wall time, or that it refuses."""
    cells, methods, robots = defaultdict(list), set(), set()
    for row in calibrations():
        if is_time(row["budget"]):
            cells[row["robot"], row["data"], row["budget"], label(row)].append(row)
            if row["data"] != "clean":
                methods.add(label(row))
                robots.add(row["robot"])
    methods = sorted(methods, key=lambda name: (name not in ("least-squares", "madoc"), name == "nominal", name))
    head = ("robot", "data", "budget", "seeds", "what the data tells, %", *methods)
    lines = [
        "## Under disturbances\n\n`python benchmarks/calibration.py --budget 60s --threads 1 --data-is ...`, with "
        "`--starts policy` for Madoc. Median of the mean absolute error over seeds, and in brackets in % of the range. "
        "*refuses*: with a sentence, kept in the result. Empty: not run. What the data tells: the median over "
        "parameters of half the width of least squares' 95 % intervals, in % of the range. *nominal* is mid-range.\n",
        f"| {' | '.join(head)} |",
        "|---" * len(head) + "|",
    ]
    for robot, data, budget in sorted({cell[:3] for cell in cells if cell[0] in robots}):
        columns = [cells.get((robot, data, budget, method), []) for method in methods]
        seeds = sorted(
            {len(column) for column, method in zip(columns, methods, strict=True) if column and method != "nominal"}
        )
        told = _half_width(cells.get((robot, data, budget, "least-squares"), []))
        words = (robot, data, budget, " to ".join(map(str, seeds[:: max(1, len(seeds) - 1)])), told)
        lines.append(f"| {' | '.join((*words, *map(_cell, columns)))} |")
    return "\n".join(lines) + "\n"


def _half_width(rows: list[dict]) -> str:
    """Half the width of intervals in % of the range, the median over parameters and seeds; empty without intervals."""
    found = [
        50.0 * (part["interval"][1] - part["interval"][0]) / (part["high"] - part["low"])
        for row in rows
        for part in row.get("parameters", {}).values()
        if part.get("interval")
    ]
    return f"{np.median(found):.2g}" if found else ""


def _cell(rows: list[dict]) -> str:
    errors = [row["error"] for row in rows if "error" in row]
    if not errors:
        return "refuses" if rows else ""
    percent = np.median([error["mean_percent_of_range"] for error in errors])
    return f"{shown([error['mean_absolute'] for error in errors]).partition(' ')[0]} ({percent:.2g})"


def label(row: dict) -> str:
    """A method and where its rollouts start, if that is not where they usually do on such data."""
    usual = "policy" if row["method"] == "madoc" else usual_starts(row["data"])
    return row["method"] if row["starts"] in ("-", usual) else f"{row['method']}, {row['starts']}"
