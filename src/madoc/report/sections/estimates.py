"""Estimates in their ranges, which act alike, hang together or are told in combination; what the model may lack."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from madoc.calibration.holdout import HoldOut
from madoc.identification.combinations import Combination
from madoc.identification.term_tests import LIKELY_FORCE, Alternative, MissingTerm
from madoc.report.charts import matrix_chart, scatter_chart
from madoc.report.reading import Run
from madoc.report.words import interval_words, number, percent, unit_words, with_error
from madoc.verdict.adequacy import CERTAIN, is_certain, numerical


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
        list(embeddings.names),
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
    titles = [names[index] for index in kept]
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


def lacks(run: Run) -> dict[str, object] | str:
    """The terms that the model may lack, and the other estimates that the intervals cover."""
    held = run.holdout
    if held is None:
        return "Nothing was held out, so the model was not tested for missing terms."
    if not held.missing_terms and not held.alternatives:
        return "No missing term was found, or the log does not tell the robot's states well enough to look for one."
    largest = max((_largest(term) for term in held.missing_terms), default=0.0)
    rows = [_row(term, largest, held, run.units) for term in held.missing_terms]
    causes = [term.cause for term in held.missing_terms]
    for at, cause in enumerate(causes):
        if causes.count(cause) > 1:
            rows[at]["cause"] = f"{cause}, shape {1 + causes[:at].count(cause)}"
    alternatives = [_words(each, held) for each in held.alternatives]
    told = {"largest": number(largest, 2), "certain": number(CERTAIN), "likely": number(LIKELY_FORCE)}
    none_certain = bool(rows) and numerical(held.missing_terms) is None and not any(map(is_certain, held.missing_terms))
    return {"rows": rows, "alternatives": alternatives, "none_certain": none_certain} | told


def _row(term: MissingTerm, largest: float, held: HoldOut, units: Mapping[str, str]) -> dict[str, object]:
    """A term as its bar shows it: the largest shift of a parameter, relative to the largest of all terms."""
    name = max(term.shifts, key=lambda each: abs(term.shifts[each]))
    _, half, of_moved = held.values[name]
    field, _, element = term.parameter.partition(".")
    unit = units.get(element, "") if field == "signal_bias" else unit_words(term.unit)
    value = f"{with_error(term.value, term.error)} {unit}".rstrip()
    return {
        "cause": term.cause,
        "parameter": term.parameter,
        "value": value,
        "t": number(term.t, 3),
        "explained": percent(term.explained),
        "moves": f"{name} by {number(term.shifts[name] * half, 2)} {unit_words(of_moved)}".rstrip(),
        "width": round(100.0 * _largest(term) / largest, 2) if largest else 0.0,
        "certain": is_certain(term),
    }


def _largest(term: MissingTerm) -> float:
    return max(map(abs, term.shifts.values()), default=0.0)


def _words(each: Alternative, held: HoldOut) -> tuple[str, str]:
    """What an alternative rests on, and how it moves the parameters."""
    moved = sorted(each.shifts, key=lambda name: -abs(each.shifts[name]))[:3]
    halves = {name: held.values[name][1] for name in moved}
    shifts = (
        f"{name} {with_error(half * each.shifts[name], half * each.errors[name])}" for name, half in halves.items()
    )
    return ", ".join(each.causes), ", ".join(shifts)


def together(run: Run) -> dict[str, object] | str:
    """Sums and products of parameters that the log tells though it leaves each of them open."""
    told: Sequence[Combination] = run.result.combinations if run.result else ()
    if not told:
        return "No sums or products of parameters are told: the log leaves no parameters open that it tells together."
    rows = [
        (each.name, f"{number(each.estimate)} {each.unit}".rstrip(), interval_words(each.interval)) for each in told
    ]
    return {"rows": rows}
