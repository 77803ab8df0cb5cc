"""The table of calibration methods under disturbances of the data, and that of what settled where it should not."""

from collections import defaultdict

import numpy as np
from kept import CALIBRATIONS, commits, is_time
from pooling import Rows, by_log, label, order


def disturbed() -> str:
    """Error of every method on every kind of data with the same budget, or that it refuses."""
    cells: dict[tuple[str, str, str], dict[str, list]] = defaultdict(lambda: defaultdict(list))
    kinds = {(row["robot"], row["quality"]) for row in CALIBRATIONS.rows() if row["data"] != "clean"}
    for row in CALIBRATIONS.rows():
        if (row["robot"], row["quality"]) in kinds and (is_time(row["budget"]) or row["data"] != "clean"):
            steps = row["budget"] if is_time(row["budget"]) else f"{row['budget']:,} steps"
            cells[f"{row['robot']}-{row['quality']}", row["data"], steps][label(row)].append(row)
    methods = sorted({name for found in cells.values() for name in found}, key=order)
    lines = [
        "## Under disturbances\n\n`python benchmarks/calibration.py --methods ... --data-is ... --logs ...`, with "
        "`--budget 60s --threads 1` where the budget is a time. Mean absolute error, the mean over logs (seeds of a "
        "log are averaged first), and in brackets in % of the range. *refuses*: with a sentence, kept in the row. "
        "Empty: not run. What the data tells: the median over parameters of half the width of least squares' 95 % "
        "intervals, in % of the range.\n",
        f"| data | kind | budget | logs | what the data tells, % | {' | '.join(methods)} | commits |",
        "|---" * (len(methods) + 6) + "|",
    ]
    for place, found in sorted(cells.items()):
        every = [row for rows in found.values() for row in rows]
        counts = sorted({len(by_log(rows)) for rows in found.values()} - {0})
        count = " to ".join(map(str, counts[:: max(1, len(counts) - 1)]))
        told = _half_width(found.get("least-squares", []))
        words = (*place, count, told, *(_cell(found.get(method, [])) for method in methods), commits(every))
        lines.append(f"| {' | '.join(words)} |")
    return "\n".join(lines) + "\n"


def settled_wrongly() -> str:
    """Estimates that call themselves settled and are no better than mid-range, which is none itself."""
    kept = (row for row in CALIBRATIONS.rows() if row["method"] not in ("nominal", "uniform"))
    rows = [row for row in kept if "mid_range" in row and "error" in row]
    measure = "mean_percent_of_range"
    wrong = [
        row
        for row in rows
        if row["status"] == "converged" and row["settled"] and row["error"][measure] >= row["mid_range"][measure]
    ]
    lines = [
        "## Settled, and no better than mid-range\n\n"
        f"{len(wrong)} of the {len(rows)} calibrations that were kept with the error of mid-range.\n"
    ]
    for row in wrong:
        told = f"{row['error'][measure]:.2g} % of the range, mid-range {row['mid_range'][measure]:.2g} %"
        place = f"{row['robot']}-{row['quality']} {row['data']} log {row['log']}"
        lines.append(f"- {label(row)} on {place}: {told} ({row['commit']})")
    return "\n".join(lines) + "\n"


def _half_width(rows: Rows) -> str:
    """Half the width of intervals in % of the range, the median over parameters and rows; empty without intervals."""
    found = [
        50.0 * (part["interval"][1] - part["interval"][0]) / (part["high"] - part["low"])
        for row in rows
        for part in row.get("parameters", {}).values()
        if part.get("interval")
    ]
    return f"{np.median(found):.2g}" if found else ""


def _cell(rows: Rows) -> str:
    errors, percent = by_log(rows), by_log(rows, "mean_percent_of_range")
    if not errors:
        return "refuses" if rows else ""
    return f"{np.mean(list(errors.values())):.2g} ({np.mean(list(percent.values())):.2g})"
