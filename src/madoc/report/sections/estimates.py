"""Estimates in their ranges, which parameters act alike, and which estimates are correlated."""

import numpy as np

from madoc.calibration import ParameterEstimate
from madoc.report.charts import matrix_chart, scatter_chart
from madoc.report.reading import Run
from madoc.report.sections.base import Section, Shown, group_colour, interval_words, place, spread_of, unit_words
from madoc.report.words import number, parameter_title


def estimates(run: Run) -> Section:
    """Every parameter in its range."""
    rows = [_estimate_row(run, name, row) for name, row in run.parameters.items()]
    spread = (
        "95 % interval"
        if any(row.interval for row in run.parameters.values())
        else "one standard deviation to either side"
    )
    lede = f"Each bar is the range that was searched; shaded: {spread}."
    data: Shown = {"rows": rows, "spread": spread, "truth": bool(run.truth), "groups": bool(run.groups)}
    absent = "There is no estimate."
    return Section("estimates", "Estimates", lede, data if rows else None, absent)


def _estimate_row(run: Run, name: str, row: ParameterEstimate) -> Shown:
    ends, truth, span = spread_of(row), run.truth.get(name), (row.low, row.high)
    shown: Shown = {
        "name": name,
        "title": parameter_title(name),
        "unit": unit_words(row.unit),
        "group": run.groups.get(name),
        "low": number(row.low),
        "high": number(row.high),
        "estimate": number(row.estimate, 4),
        "spread": interval_words(ends) if row.interval else f"± {number(row.std, 2)}",
        "at": place(row.estimate, *span),
        "from": place(ends[0], *span),
        "to": place(ends[1], *span),
        "truth": None,
        "truth_at": None,
    }
    if truth is None:
        return shown
    off = 100 * abs(row.estimate - truth) / (row.high - row.low)
    return shown | {"truth": number(truth), "truth_at": place(truth, *span), "off_percent": number(off, 2)}


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
        for index, names in enumerate(run.result.groups if run.result else [])
    ]
    return Section("grouping", title, lede, {"chart": chart, "groups": groups})


def correlations(run: Run) -> Section:
    """Which estimates can make up for each other."""
    title = "What makes up for what"
    lede = (
        "Correlation of the estimates. Near 1 or −1 the data can hardly tell the two apart: the simulator moves "
        "alike when both change together, the same way (blue) or opposite ways (orange)."
    )
    rows = run.result.covariance if run.result else None
    names = list(run.parameters)
    if rows is None or len(names) < 2:
        absent = (
            "With one parameter there is nothing to correlate."
            if len(names) == 1
            else "This method does not say how its estimates hang together."
        )
        return Section("correlations", title, lede, None, absent)
    covariance = np.asarray(rows, dtype=float)
    kept = np.flatnonzero(np.diag(covariance) > 0)
    if len(kept) < 2:
        return Section("correlations", title, lede, None, "The estimates have no spread, so none hang together.")
    deviation = np.sqrt(np.diag(covariance)[kept])
    matrix = covariance[np.ix_(kept, kept)] / np.outer(deviation, deviation)
    titles = [parameter_title(names[index]) for index in kept]
    pairs = [
        (abs(float(matrix[row, column])), titles[row], titles[column], float(matrix[row, column]))
        for row in range(len(kept))
        for column in range(row)
    ]
    strongest = sorted(pairs, reverse=True)[:3]
    told = [f"{first} and {second}: {number(value, 2)}" for size, first, second, value in strongest if size > 0.5]
    chart = matrix_chart(matrix, titles, label="correlation of the estimates")
    return Section("correlations", title, lede, {"chart": chart, "told": told})
