"""Estimates in their ranges, which parameters act alike, and which estimates are correlated."""

import numpy as np
from jaxtyping import Float

from madoc.report.charts import matrix_chart, scatter_chart
from madoc.report.reading import Run
from madoc.report.words import number, parameter_title


def estimates(run: Run) -> dict[str, object] | str:
    """Every parameter in its range."""
    if not run.parameters:
        return "There is no estimate."
    intervals = any(row.interval for row in run.parameters.values())
    given = any(row.given is not None for row in run.parameters.values())
    spread = "95 % interval" if intervals else "one standard deviation to either side"
    return {"run": run, "spread": spread, "given": given}


def grouping(run: Run) -> dict[str, object] | str:
    """Which parameters act alike."""
    embeddings = run.embeddings
    if embeddings is None or len(embeddings.names) < 3:
        if run.groups:
            return "The parameters were grouped, but the run kept no embeddings to draw."
        return "This method does not group parameters by what they do, so there is no picture of it."
    points, shares = plane_of(embeddings.vectors)
    chart = scatter_chart(
        points,
        [parameter_title(name) for name in embeddings.names],
        [run.colour(name) for name in embeddings.names],
        label="parameters in the plane of their embeddings",
        titles=(f"first component, {100 * shares[0]:.0f} % of the variance", f"second, {100 * shares[1]:.0f} %"),
    )
    groups, stability = (run.result.groups, run.result.group_stability) if run.result else ([], None)
    return {"chart": chart, "groups": groups, "stability": None if stability is None else f"{stability:.2f}"}


def plane_of(
    vectors: Float[np.ndarray, "points components"],
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, " shares"]]:
    """Points in the plane of the two directions in which they differ most, and shares of the variance by direction.

    The point that is farthest out in a direction is on its positive side: the same vectors make the same picture.
    """
    left, singular, _ = np.linalg.svd(vectors - vectors.mean(0), full_matrices=False)
    points = left[:, :2] * singular[:2]
    farthest = np.take_along_axis(points, np.abs(points).argmax(0)[None], axis=0)
    return np.where(farthest < 0.0, -points, points), singular**2 / max(float((singular**2).sum()), 1e-300)


def correlations(run: Run) -> dict[str, object] | str:
    """Which estimates are correlated."""
    names = list(run.parameters)
    if len(names) == 1:
        return "With one parameter there is nothing to correlate."
    if run.result is None or run.result.covariance is None:
        return "This method gives no covariance of its estimates."
    covariance = np.asarray(run.result.covariance, dtype=float)
    kept = np.flatnonzero(np.diag(covariance) > 0)
    if len(kept) < 2:
        return "The estimates have no spread, so none hang together."
    deviation = np.sqrt(np.diag(covariance)[kept])
    matrix = covariance[np.ix_(kept, kept)] / np.outer(deviation, deviation)
    titles = [parameter_title(names[index]) for index in kept]
    pairs = [
        (abs(float(matrix[row, column])), titles[row], titles[column], float(matrix[row, column]))
        for row in range(len(kept))
        for column in range(row)
    ]
    strongest = [
        f"{first} and {second}: {number(value, 2)}"
        for size, first, second, value in sorted(pairs, reverse=True)[:3]
        if size > 0.5
    ]
    return {"chart": matrix_chart(matrix, titles, label="correlation of the estimates"), "strongest": strongest}
