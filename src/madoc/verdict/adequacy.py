"""Whether the model is adequate for an estimate: the terms that it seems to lack, and what they do to the intervals."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from madoc.calibration.holdout import HoldOut, Judged, JudgedByErrors
from madoc.calibration.result import CalibrationResult
from madoc.identification.candidate_terms import of_steps
from madoc.identification.causes import INTEGRATION
from madoc.identification.combinations import Combination
from madoc.identification.information import NORMAL_95
from madoc.identification.missing_terms import OTHER_WINDOWS
from madoc.identification.term_tests import SUSPICIOUS, Alternative, MissingTerm, named
from madoc.verdict.statistics import beyond_noise

CERTAIN = 5.0
"""|t| from which a term is missing; by chance one in two million is larger where residuals are normal."""
SMALLEST = 0.3
"""Smallest value of the error of the integration step in proportion to which its effects are taken larger."""
NUMERICAL = 0.3
"""Share of squared residuals explained by the integration step; above it they are no mismatch of the model."""
NEARLY = 0.8
"""Share explained by a term over that of the one named; terms above it are as likely."""
WORTH_NAMING = 0.02
"""Share in [0, 1] of the squared residuals that a term must explain to be named as what the model lacks."""
SURER = 1.314
"""Half of a 99 % interval over half of a 95 % interval: an alternative is covered unless one in a hundred is worse."""
NAMED = 3
"""Number of causes named for which intervals are widened, and of terms that the log cannot tell."""


def missing_term(holdout: Judged, least: float | None = None) -> MissingTerm | None:
    """The likeliest term that the model certainly lacks.

    One that moves no estimate counts too: what it would move is known to first order, at an estimate that may be wrong.
    A force or a value that explains less than a share `least` of the squared residuals does not, `worth_naming` by
    default: where errors are those of noise, intervals cover the estimate with it, and where they are far beyond noise
    something else makes them.
    """
    least = worth_naming(holdout.missing_terms) if least is None else least
    return likeliest([term for term in holdout.missing_terms if is_certain(term) and not _is_small(term, least)])


def worth_naming(terms: Sequence[MissingTerm]) -> float:
    """Share in [0, 1] of the squared residuals from which a term is named: not what the timestep's error leaves.

    At contacts derivatives follow a part of that error only: its value comes out below 1 by the part that is left.
    """
    step = integration(terms)
    left = 0.0 if step is None or step.t < SUSPICIOUS else (1.0 - step.value) * step.explained
    return max(WORTH_NAMING, left)


def of_small_terms(terms: Sequence[MissingTerm]) -> tuple[Alternative, ...]:
    """The estimate with each term that is certain and explains too little to be named, for intervals to cover."""
    small = [term for term in terms if is_certain(term) and _is_small(term, worth_naming(terms))]
    return tuple(
        Alternative(
            (named(term),),
            shifts=dict(term.shifts),
            errors={name: NORMAL_95 * abs(shift / term.t) for name, shift in term.shifts.items()},
        )
        for term in small
    )


def _is_small(term: MissingTerm, least: float) -> bool:
    return term.explained < least and term.about.group != "change"


def far_beyond_noise(holdout: Judged) -> bool:
    """Whether even the parameters nearby that fit the hold-out best leave errors that noise does not explain.

    Where a shorter timestep was tested, what that one lacks tells, as these may be errors of the longer one.
    """
    errors = holdout.errors if isinstance(holdout, JudgedByErrors) and holdout.timestep_of_tests != "shorter" else None
    return errors is not None and bool(beyond_noise(errors.nearby_best, errors.noise, certain=True))


def likeliest(terms: Sequence[MissingTerm]) -> MissingTerm | None:
    """Of certain terms the one that explains most, or nearly as much if that is unusual; None of none.

    A tilted base looks like an offset of a sensor, which is more usual. Actions that seem to come early are more often
    a sign of forces that the model lacks, and values that change within each run may be one of motions that do. A force
    that no parameter adds is named only where no other term explains nearly as much, and one that is not listed only
    where no listed one does.
    """
    listed = max((term.explained for term in terms if not _unlisted(term)), default=0.0)
    terms = [term for term in terms if not _unlisted(term) or listed < NEARLY * term.explained]
    enough = NEARLY * max((term.explained for term in terms), default=0.0)
    likely = [term for term in terms if term.explained >= enough]
    return max(likely, key=lambda term: (not term.about.unusual, term.explained), default=None)


def _unlisted(term: MissingTerm) -> bool:
    return term.about.group == "unlisted"


def as_likely(terms: Sequence[MissingTerm], named: MissingTerm) -> list[MissingTerm]:
    """Other terms that are certain and explain nearly as much: the log hardly tells which of them is missing."""
    return [
        term
        for term in terms
        if (term.cause, term.parameter) != (named.cause, named.parameter)
        and is_certain(term)
        and term.about.group != "change"
        and term.explained >= NEARLY * named.explained
        and (_unlisted(named) or not _unlisted(term))
    ]


def is_certain(term: MissingTerm) -> bool:
    """Whether a term is so significant that it is missing, whatever it does to the estimate."""
    return term.cause != INTEGRATION and abs(term.t) >= CERTAIN


def numerical(terms: Sequence[MissingTerm]) -> MissingTerm | None:
    """The error of the integration step, where it explains much of the residuals, and no certain term explains more."""
    step = integration(terms)
    if step is None or step.t < SUSPICIOUS or step.explained < NUMERICAL:
        return None
    others = (each.explained for each in terms if is_certain(each) and each.about.group != "change")
    return step if max(others, default=0.0) <= step.explained else None


def of_timestep(holdout: Judged) -> bool:
    """Whether errors beyond noise may be those of the timestep that they were measured with."""
    if holdout.timestep_of_tests != "same":
        return holdout.timestep_of_tests == "shorter"  # the log does not exclude it; a longer one tells of other errors
    return numerical(holdout.missing_terms) is not None


def integration(terms: Sequence[MissingTerm]) -> MissingTerm | None:
    """The error of the integration step, if its value is one that it can have.

    Smaller steps change predictions by that error once, and at contacts derivatives follow less than all of it. A value
    beyond that, or of the other sign, is of something else, such as a late action.
    """
    return next((term for term in terms if term.cause == INTEGRATION and of_steps(term.value)), None)


def in_full(alternatives: tuple[Alternative, ...], terms: Sequence[MissingTerm]) -> tuple[Alternative, ...]:
    """The alternatives, with the error of the integration step in full where it explains much of the residuals.

    Where motion is smooth its value is about 1. At contacts it comes out smaller, as derivatives do not follow jumps,
    and other estimates that rest on it, alone or with other terms, or on windows of another length, move in proportion.
    """
    step = numerical(terms)
    if step is None or step.value >= 1.0:
        return alternatives
    factor = 1.0 / max(step.value, SMALLEST)
    return tuple(
        replace(
            each,
            shifts={name: factor * shift for name, shift in each.shifts.items()},
            errors={name: factor * error for name, error in each.errors.items()},
        )
        if {INTEGRATION, OTHER_WINDOWS} & set(each.causes)
        else each
        for each in alternatives
    )


def widening(alternatives: tuple[Alternative, ...], names: tuple[str, ...]) -> Float[np.ndarray, "d 2"]:
    """By how many half-widths each interval's low and high end must move out to cover every alternative as well.

    An alternative's own interval is its estimate and, to either side, the root of the sum of the squares of the given
    half-width and of half the 99 % interval of the shift: the two are independent, as terms are tested beside the
    parameters. The shift's interval is the wider one because a model that lacks something is to be covered more surely
    than a right one. Of a shift with bounds all values within them are covered, each with the given half-width.
    """
    ends = np.ones((len(names), 2))
    for each in alternatives:
        for index, name in enumerate(names):
            if name in each.shifts:
                shift, reach = each.shifts[name], _reach(each, each.errors[name], 1.0)
                ends[index] = np.maximum(ends[index], [reach - shift, reach + shift])
    return ends - 1.0


def _reach(alternative: Alternative, error: float, half_width: float) -> float:
    """How far an alternative's own interval reaches, whose shift has an error or a bound."""
    return half_width + error if alternative.bounded else float(np.hypot(half_width, SURER * error))


def with_widened_intervals(result: CalibrationResult, holdout: HoldOut) -> CalibrationResult:
    """The result with intervals that cover the alternatives as well, and a warning that says so."""
    if result.interval is None:
        return result
    ends = widening(holdout.alternatives, tuple(result.parameters))
    grown = {
        name: (low, high) for name, (low, high) in zip(result.parameters, ends.tolist(), strict=True) if low + high
    }
    if not grown:
        return result
    told = [_covering(combination, result, holdout.alternatives) for combination in result.combinations]
    return replace(result.with_intervals(grown, _sentence(holdout.alternatives, tuple(grown))), combinations=told)


def about_imitated(holdout: HoldOut) -> tuple[str, ...]:
    """A sentence on the terms that calibrated parameters imitate, which no verdict and no interval covers."""
    if not holdout.imitated:
        return ()
    which = [f"{each.cause} ({each.parameter}) from {' and '.join(each.imitators)}" for each in holdout.imitated]
    if len(which) > NAMED:
        which = [*which[:NAMED], f"{len(which) - NAMED} more terms"]
    return (
        f"the log cannot tell {'; '.join(which)}: estimates assume that the machine has no more of it than the model; "
        "if it may, add it to the spec, or log motions that tell them apart",
    )


def _covering(
    combination: Combination, result: CalibrationResult, alternatives: tuple[Alternative, ...]
) -> Combination:
    """The combination with an interval that covers the alternatives, to first order in their shifts."""
    low, high = combination.interval
    below, above = combination.estimate - low, high - combination.estimate
    for each in alternatives:
        shift = error = 0.0
        for name, factor in combination.parameters.items():
            row = result.parameters[name]
            if name in each.shifts and row.interval is not None:
                slope = factor if combination.kind == "sum" else factor * combination.estimate / row.estimate
                half = slope * row.half_width
                shift, error = shift + half * each.shifts[name], error + abs(half) * each.errors[name]
        low = min(low, combination.estimate + shift - _reach(each, error, below))
        high = max(high, combination.estimate + shift + _reach(each, error, above))
    return replace(combination, interval=(low, high))


def _sentence(alternatives: tuple[Alternative, ...], names: tuple[str, ...]) -> str:
    """The causes whose estimates move an end of these parameters' intervals, those that move one furthest first."""
    moved = np.array([widening((each,), names).max() for each in alternatives])
    furthest = [alternatives[index] for index in np.argsort(-moved, kind="stable") if moved[index] > 0.0]
    causes = [*dict.fromkeys(cause for each in furthest for cause in each.causes)]
    more = len(causes) - NAMED
    others = f" and {more} more effect{'s' * (more > 1)}" if more > 0 else ""
    return (
        "95 % intervals are wider than the standard deviations, which count noise alone: they also cover what the data "
        f"does not exclude, {', '.join(causes[:NAMED])}{others}"
    )
