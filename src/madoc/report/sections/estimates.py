"""What was found: estimates in their ranges, what acts alike, what makes up for what."""

from typing import Any

import numpy as np

from madoc.report.charts import matrix_chart, scatter_chart
from madoc.report.reading import Run
from madoc.report.sections.base import Section, group_colour, span_words
from madoc.report.words import number, parameter_title


def estimates(run: Run) -> Section:
    """Every parameter in its range."""
    rows = [_estimate_row(run, name, row) for name, row in run.parameters.items()]
    spread = "95 % interval" if any(row["interval"] for row in rows) else "one standard deviation to either side"
    lede = f"Each bar is the range that was searched; shaded: {spread}."
    data = {"rows": rows, "spread": spread, "truth": bool(run.truth), "groups": bool(run.groups)}
    absent = "There is no estimate."
    return Section("estimates", "Estimates", lede, data if rows else None, absent)


def _estimate_row(run: Run, name: str, row: dict[str, Any]) -> dict[str, Any]:
    low, high, middle = row["low"], row["high"], row["estimate"]
    interval = row.get("interval")
    ends = interval or (middle - row["std"], middle + row["std"])

    def place(value: float) -> float:
        return round(min(max((value - low) / (high - low), 0.0), 1.0) * 100, 3)

    truth = run.truth.get(name)
    return {
        "name": name,
        "title": parameter_title(name),
        "unit": "" if row["unit"] == "1" else row["unit"],
        "group": run.groups.get(name),
        "low": number(low),
        "high": number(high),
        "estimate": number(middle, 4),
        "interval": interval,
        "spread": span_words(ends) if interval else f"± {number(row['std'], 2)}",
        "at": place(middle),
        "from": place(ends[0]),
        "to": place(ends[1]),
        "truth": None if truth is None else number(truth),
        "truth_at": None if truth is None else place(truth),
        "off": None if truth is None else number(abs(middle - truth), 2),
        "off_percent": None if truth is None else number(100 * abs(middle - truth) / (high - low), 2),
    }


def grouping(run: Run) -> Section:
    """Which parameters act alike."""
    title = "What acts alike"
    lede = (
        "Each parameter as the method sees its effect on the robot: near points change next states alike. "
        "The plane is that of the two directions in which the embeddings differ most; colours are the groups."
    )
    embeddings = run.embeddings
    if embeddings is None or len(embeddings.names) < 3:
        absent = (
            "The parameters were grouped, but the run kept no embeddings to draw."
            if run.groups
            else "This method does not group parameters by what they do, so there is no picture of it."
        )
        return Section("grouping", title, lede, None, absent)
    centred = embeddings.vectors - embeddings.vectors.mean(0)
    left, singular, _ = np.linalg.svd(centred, full_matrices=False)
    plane = left[:, :2] * singular[:2]
    shares = singular**2 / max(float((singular**2).sum()), 1e-300)
    chart = scatter_chart(
        plane,
        [parameter_title(name) for name in embeddings.names],
        [group_colour(run, name) for name in embeddings.names],
        label="parameters in the plane of their embeddings",
        titles=(f"first component, {100 * shares[0]:.0f} % of the variance", f"second, {100 * shares[1]:.0f} %"),
    )
    groups = [
        {"colour": f"g{index % 8}", "members": [parameter_title(name) for name in names]}
        for index, names in enumerate(run.result.get("groups", []))
    ]
    return Section("grouping", title, lede, {"chart": chart, "groups": groups})


def correlations(run: Run) -> Section:
    """Which estimates can make up for each other."""
    title = "What makes up for what"
    lede = (
        "Correlation of the estimates. Near 1 or −1 the data can hardly tell the two apart: the simulator moves "
        "alike when both change together, the same way (blue) or opposite ways (orange)."
    )
    rows = run.result.get("covariance")
    names = list(run.parameters)
    if rows is None or len(names) < 2:
        absent = (
            "With one parameter there is nothing to correlate."
            if len(names) == 1
            else "This method does not say how its estimates hang together."
        )
        return Section("correlations", title, lede, None, absent)
    covariance = np.asarray(rows, dtype=float)
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    kept = np.flatnonzero(deviation > 0)
    if len(kept) < 2:
        return Section("correlations", title, lede, None, "The estimates have no spread, so none hang together.")
    matrix = (covariance / np.outer(np.where(deviation > 0, deviation, 1), np.where(deviation > 0, deviation, 1)))[
        np.ix_(kept, kept)
    ]
    titles = [parameter_title(names[index]) for index in kept]
    pairs = [
        (abs(float(matrix[row, column])), titles[row], titles[column], float(matrix[row, column]))
        for row in range(len(kept))
        for column in range(row)
    ]
    strongest = sorted(pairs, reverse=True)[:3]
    told = [f"{first} and {second}: {number(value, 2)}" for size, first, second, value in strongest if size > 0.5]
    return Section(
        "correlations",
        title,
        lede,
        {"chart": matrix_chart(matrix, titles, label="correlation of the estimates"), "told": told},
    )
