"""What a model lacks, as the hold-out and the tests at the estimate show it: each way is a verdict of its own."""

from dataclasses import replace

import numpy as np

from madoc.calibration.holdout import Area, Fitted, HoldOut, PredictionErrors, ToldApart, Verdict
from madoc.identification.causes import ONE_RUN, WITHIN_RUNS
from madoc.identification.fitted_windows import NEGLIGIBLE
from madoc.identification.term_tests import MissingTerm, named
from madoc.verdict.adequacy import CERTAIN, as_likely, far_beyond_noise, integration, missing_term, of_timestep
from madoc.verdict.remedies import addition, is_of_spec, remedy, value_of

_MOST_NAMED = 3
"""Largest number of terms that a sentence names beside the likeliest."""
SEPARABLE = 0.65
"""Area under the curve in [0.5, 1]; above it simulated rows differ from logged ones. Rollouts of a cloned policy in the
true simulator have about 0.55."""


def lacking(holdout: HoldOut, *, settled: bool, unlike_noise: bool) -> Verdict | None:
    """The first of the ways in which a model lacks something; None where there is none.

    An end of a range at which a search stands that has not settled says nothing. `unlike_noise` tells that residuals
    have longer tails than noise has, that they add up, that each is like the next, or that they follow from state and
    action.
    """
    holdout = holdout if settled else replace(holdout, at_end=(), open_at_end=())
    found = _missing(holdout, missing_term(holdout)) or _mismatch(holdout)
    if far_beyond_noise(holdout) and not of_timestep(holdout):
        found = found or _missing(holdout, missing_term(holdout, least=0.0))
    found = found or _outside(holdout)
    return found or (_unlike_noise(holdout) if unlike_noise else None)


def _missing(holdout: HoldOut, term: MissingTerm | None) -> Verdict | None:
    """A term that the model lacks and that moves the estimate, with the line that adds it to the spec."""
    if term is None:
        return None
    value = value_of(term)
    if term.about.group == "change":
        return Verdict("MODEL_MISMATCH", _changing(holdout, term), (term.parameter,))
    moved = sorted(term.shifts, key=lambda name: -abs(term.shifts[name]))[:2]
    effect = " and ".join(_moved(holdout, term, name) for name in moved)
    sure = _proved(holdout, term) or term.about.group == "unlisted"
    lacks = "the model lacks" if sure else "what the model lacks acts like"
    return Verdict(
        "MODEL_MISMATCH",
        f"{lacks} {named(term)}: a value of {value} explains {100 * term.explained:.2g} % of the squared residuals "
        f"(t = {abs(term.t):.1f}), and would move {effect}{_coarser(holdout, term)}; {_advice(holdout, term)}"
        f"{_at_end(holdout)}{_disagreeing(holdout)}",
        tuple(moved),
    )


def _coarser(holdout: HoldOut, term: MissingTerm) -> str:
    """A clause on the error of the integration step, where it is certain and explains more than the term; or none."""
    step = integration(holdout.missing_terms)
    if step is None or step.t < CERTAIN or step.explained <= term.explained:
        return ""
    explains = f"explains {100 * step.explained:.2g} % (t = {abs(step.t):.1f})"
    return f"; first take a smaller timestep of the model, whose error {explains}"


def _moved(holdout: HoldOut, term: MissingTerm, name: str) -> str:
    """By how much a term would move an estimate, in the parameter's unit."""
    estimate, half_width, unit = holdout.values[name]
    return f"{name} by {half_width * term.shifts[name]:+.2g} from {estimate:.4g} {unit}".removesuffix(" 1")


def _changing(holdout: HoldOut, term: MissingTerm) -> str:
    """How a parameter changes over the log, by how much, and what to do."""
    value = value_of(term)
    moved = f"(t = {abs(term.t):.1f}; its estimate is {holdout.values[term.parameter][0]:.3g})"
    if term.cause.startswith(ONE_RUN):
        run = term.cause.removeprefix(f"{ONE_RUN} (").removesuffix(")")
        return (
            f"{term.parameter} is another one in {run}: it differs there by {value} from all other runs {moved}; "
            f"{term.about.do}"
        )
    if term.cause == WITHIN_RUNS:
        change = value_of(replace(term, value=2.0 * term.value))
        return (
            f"{term.parameter} drifts: it changes within each run by {change} from the start of a run to its end "
            f"{moved}; {term.about.do}"
        )
    return f"{term.parameter} drifts: it changes by {value} between parts of the log {moved}; {term.about.do}"


def _proved(holdout: HoldOut, term: MissingTerm) -> bool:
    """Whether the model with a term explains the log, and no other term explains nearly as much."""
    richer = holdout.richer
    explains = richer is not None and richer.parameter == term.parameter and not richer.left
    return explains and not _rivals(holdout, term)


def _rivals(holdout: HoldOut, term: MissingTerm) -> list[MissingTerm]:
    """Other terms that explain nearly as much, but for those that were added with it."""
    added = [(each.cause, each.parameter) for each in holdout.richer.others] if holdout.richer is not None else []
    return [each for each in as_likely(holdout.missing_terms, term) if (each.cause, each.parameter) not in added]


def _advice(holdout: HoldOut, term: MissingTerm) -> str:
    """What to do about a term: the line that adds it only where the model with it explains the log, and no other does.

    Terms that explain nearly as much are told with it.
    """
    others = list(dict.fromkeys(map(named, _rivals(holdout, term))))[:_MOST_NAMED]
    alike = f"{' or '.join(others)} would explain nearly as much" if others else ""
    if not is_of_spec(term):
        return "; ".join(part for part in (alike, remedy(term)) if part)
    if _proved(holdout, term):
        further = holdout.richer.others if holdout.richer is not None else ()
        whole = " and ".join(("it", *map(named, further)))
        return f"a model with {whole} explains the log: {addition((term, *further))}"
    richer = holdout.richer
    if richer is None or richer.parameter != term.parameter:
        whole = "whether that is all that it lacks was not tested, so look for the cause before you add it to the spec"
    elif richer.left:
        whole = f"a model with it still lacks {richer.left[0]}, so look for the cause before you add either to the spec"
    else:
        whole = "find out on the machine which of them it is, and add that one to the spec's parameters"
    return "; ".join(part for part in (alike, whole) if part)


def _at_end(holdout: HoldOut) -> str:
    """Which estimates are at an end of their range, where other terms may make up for what lies beyond it."""
    names = ", ".join((*holdout.at_end, *holdout.open_at_end))
    return f"; {names} at the end of the range: the true value may lie beyond it, so widen it first" if names else ""


def _disagreeing(holdout: HoldOut) -> str:
    """Which parameters the parts of the log disagree on."""
    names = dict.fromkeys(name for each in holdout.alternatives if each.parts for name in each.shifts)
    return f"; parts of the log disagree on {', '.join(names)}" if names else ""


def contradicted(holdout: HoldOut) -> Verdict | None:
    """A log that the check before the calibration found to contradict the spec."""
    if not holdout.contradictions:
        return None
    return Verdict("MODEL_MISMATCH", f"the log contradicts the spec: {holdout.contradictions[0]}")


def _outside(holdout: HoldOut) -> Verdict | None:
    """An estimate at the end of its range, beyond which the true value may lie."""
    if not holdout.at_end:
        return None
    return Verdict(
        "MODEL_MISMATCH",
        f"{', '.join(holdout.at_end)} at the end of the range: the true value may lie beyond it, and then the other "
        "parameters make up for it; widen the range",
        holdout.at_end,
    )


def _unlike_noise(holdout: HoldOut) -> Verdict | None:
    """Residuals unlike noise, where the error of the integration step does not explain them."""
    if of_timestep(holdout):
        return None
    return Verdict(
        "MODEL_MISMATCH",
        "residuals are unlike noise (a warning says in what): the model does not explain the whole log, and intervals "
        "count noise alone; look for a force that depends on the motion, as drag does, or acts at "
        "times only, at contacts or in fast motion, for wrong or missing readings and for values that differ between "
        "runs",
    )


def _mismatch(holdout: HoldOut) -> Verdict | None:
    if of_timestep(holdout):
        return None
    sentence = ""
    if isinstance(holdout, ToldApart):
        sentence = _separable(holdout)
    elif isinstance(holdout, Fitted):
        sentence = _from_fitted_starts(holdout)
    if not sentence:
        return None
    return Verdict("MODEL_MISMATCH", sentence, holdout.at_end)


def _from_fitted_starts(holdout: Fitted) -> str:
    """How the errors of the best parameters nearby exceed those of noise; else empty.

    Nothing tells random forces from what the model lacks there.
    """
    if not far_beyond_noise(holdout):
        return ""
    errors = holdout.errors
    pairs = list(zip(errors.nearby_best, errors.noise, strict=True))
    left, noise = max(pairs, key=lambda pair: pair[0].mean / max(pair[1].mean, NEGLIGIBLE))
    much = (
        f"{left.mean / noise.mean:.2g} times as much as noise does" if noise.mean > NEGLIGIBLE else "none of it noise"
    )
    return (
        f"the model cannot explain the data: after {in_rows(left.steps)} from a fitted start even the parameters "
        f"nearby that fit the hold-out best err by {left.mean:.2g} of what a signal changes in "
        f"{in_rows(errors.stride)}, {much} ({change_of(errors)}){_at_end(holdout)}"
    )


def _separable(holdout: ToldApart) -> str:
    """How well a classifier separates simulated from logged rows, if better than `SEPARABLE`; else empty."""
    before, after = holdout.area_at_mid_range, holdout.area_at_estimate
    if after.interval[0] <= SEPARABLE or after.area >= before.area:
        return ""
    return (
        f"a classifier still tells rows of the simulator from those held out, {of_area(after)} after {of_area(before)} "
        "at mid-range (0.5 is chance): the model cannot move as the data does, or the search is not at its end"
        f"{_at_end(holdout)}"
    )


def change_of(errors: PredictionErrors) -> str:
    """Errors after the most rows: at mid-range, then at the estimate."""
    before, after = errors.mid_range[-1], errors.estimate[-1]
    change = f"of what a signal changes in {in_rows(errors.stride)}"
    both = f"mid-range errs by {before.mean:.2g} and the estimate by {after.mean:.2g}"
    return f"{both} {change}, after {in_rows(after.steps)}"


def of_area(area: Area) -> str:
    """An area under the curve, with its interval."""
    low, high = area.interval
    return f"{area.area:.2f} [{low:.2f}, {high:.2f}]"


def in_rows(count: int) -> str:
    """A number of rows of a log, which are control steps of its robot."""
    return "1 row" if count == 1 else f"{count} rows"


def at_most(share: float) -> str:
    """A share in percent, rounded up to two digits, or up to a whole number from 99.5 on."""
    digit = 10.0 ** (np.floor(np.log10(max(share, 1e-12))) - 1)
    return in_percent(float(np.ceil(share / digit - 1e-9) * digit + 0.0))


def in_percent(share: float) -> str:
    """A share in percent, with three digits near 100; a question mark for one that is not finite."""
    return f"{100 * share:.{2 if share < 0.995 else 3}g} %" if np.isfinite(share) else "?"
