"""Whether the model is adequate for an estimate: the terms that it seems to lack, and what they do to the intervals."""

import numpy as np
from jaxtyping import Float

from madoc.calibration.holdout import HoldOut
from madoc.calibration.result import CalibrationResult
from madoc.identification.missing_terms import DRIFT, INTEGRATION, SUSPICIOUS, MissingTerm

CERTAIN = 5.0
"""|t| from which a term is missing; by chance one in two million is larger where residuals are normal."""
CERTAIN_DRIFT = 6.0
"""The same for a parameter that changes over the log, whose standard error rests on a third of the windows."""
MOVES = 0.5
"""Shift of a parameter in half-widths of its 95 % interval; a term that moves all by less may be left out."""
NUMERICAL = 0.5
"""Share of squared residuals explained by the integration step; above it they are no mismatch of the model."""


def missing_term(holdout: HoldOut) -> MissingTerm | None:
    """The most significant term that the model certainly lacks and that would move the estimate.

    None where the integration step explains most of the residuals: beside its error no other can be told.
    """
    if numerical(holdout) is not None:
        return None
    for term in holdout.missing_terms:
        certain = CERTAIN_DRIFT if term.cause == DRIFT else CERTAIN
        if term.cause != INTEGRATION and abs(term.t) >= certain and _largest_shift(term) >= MOVES:
            return term
    return None


def numerical(holdout: HoldOut) -> MissingTerm | None:
    """The error of the integration step, where it explains most of the residuals."""
    term = next((term for term in holdout.missing_terms if term.cause == INTEGRATION), None)
    return term if term is not None and abs(term.t) >= CERTAIN and term.explained >= NUMERICAL else None


def widening(terms: tuple[MissingTerm, ...], names: tuple[str, ...]) -> Float[np.ndarray, " d"]:
    """By how many half-widths each interval must grow to either side to cover a term that cannot be excluded.

    The error of the integration step counts twice where it is significant, as it changes with the length of windows,
    and of the other terms the most significant one.
    """
    doubtful = [term for term in terms if abs(term.t) >= SUSPICIOUS and term.cause != DRIFT]
    numerical = [term for term in doubtful if term.cause == INTEGRATION]
    physical = [term for term in doubtful if term.cause != INTEGRATION]
    counted = (*numerical, *numerical, *physical[:1])
    shifts = [[abs(term.shifts[name]) for name in names] for term in counted]
    return np.sum(shifts, axis=0) if shifts else np.zeros(len(names))


def with_widened_intervals(result: CalibrationResult, holdout: HoldOut) -> CalibrationResult:
    """The result with intervals that cover terms which cannot be excluded, and a warning that says so."""
    factors = widening(holdout.missing_terms, tuple(result.parameters))
    grown = {name: factor for name, factor in zip(result.parameters, factors, strict=True) if factor > 0.0}
    if result.interval is None or not grown:
        return result
    return result.with_intervals(grown, _sentence(holdout.missing_terms))


def _sentence(terms: tuple[MissingTerm, ...]) -> str:
    doubtful = [term for term in terms if abs(term.t) >= SUSPICIOUS and term.cause != DRIFT]
    named = list(dict.fromkeys(term.cause for term in doubtful if term.cause == INTEGRATION))
    named += [_named(term) for term in doubtful if term.cause != INTEGRATION][:1]
    return f"intervals were widened to cover {' and '.join(named)}, which the data does not exclude"


def _named(term: MissingTerm) -> str:
    what = f"{term.cause} ({term.parameter})" if term.parameter else term.cause
    return f"{what} of {term.value:.2g} ± {term.standard_error:.1g} {term.unit}".rstrip()


def _largest_shift(term: MissingTerm) -> float:
    return max(abs(shift) for shift in term.shifts.values())
