"""The verdict on an estimate: one word, and a sentence with the numbers behind it.

It answers two questions: does the simulator predict, and can the numbers be believed? An estimate that predicts though
its model lacks something is `USABLE`: its numbers serve in this simulator and are not those of the machine.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from madoc.calibration.holdout import (
    Area,
    Fitted,
    HoldOut,
    OpenLoop,
    Predicted,
    PredictionErrors,
    ToldApart,
    Verdict,
)
from madoc.identification.combinations import Combination
from madoc.identification.drifts import DRIFTS, WITHIN_RUNS
from madoc.identification.information import OPEN
from madoc.identification.missing_terms import OTHER_WINDOWS
from madoc.identification.term_tests import MissingTerm, named
from madoc.verdict.adequacy import about_timestep, as_likely, is_certain, likeliest, missing_term, numerical
from madoc.verdict.remedies import WARM_UP, remedy, value_of
from madoc.verdict.statistics import FEWEST_GROUPS, NEGLIGIBLE, WORTH_GAINING, beyond_noise
from madoc.verdict.systematic import EXPLAINED

UNSETTLED = "the search had not settled when its budget ended: resume it with a larger one"

CHANCE = 0.01
"""Significance level in [0, 1]: data is rejected where no prediction is better than chance at this level."""
SKILL = 0.1
"""Skill of the best prediction, at most 1; data is rejected below it, however significant the prediction is."""
WHITE = 0.2
"""Autocorrelation in [-1, 1]; above it residuals are not white. It is four standard errors of 400 independent rows."""
PERSISTENT = 0.1
"""Correlation in [-1, 1] of residuals with those a few rows later, above which a force is missing that lasts."""
BEYOND_RANDOM = 1.3
"""Lower end of the 95 % interval of a signal's error over that of noise and random forces; above it something adds up
that is not random."""
GAINED = 0.75
"""Share in [0, 1] of the possible gain over mid-range on the hold-out; with less, an estimate is no improvement."""
_MOST_NAMED = 3
"""Largest number of terms that a sentence names beside the likeliest."""
MUCH_BETTER = 0.8
"""Error of open-loop predictions over that of the model as given, at or below which an estimate is of use though the
model lacks something."""
SEPARABLE = 0.65
"""Area under the curve in [0.5, 1]; above it simulated rows differ from logged ones. Rollouts of a cloned policy in the
true simulator have about 0.55."""


def judge(
    holdout: HoldOut, *, settled: bool = True, long_tails: bool = False, combinations: Sequence[Combination] = ()
) -> Verdict:
    """The first verdict that applies: rejected data, a model that lacks something, open parameters, no improvement.

    What the model lacks makes an estimate `USABLE` where it predicts much better than the model as given, and else a
    mismatch. A log that is too short to tell whether the model lacks a term, or tells no states, leaves its parameters
    open.

    Args:
        holdout: What the hold-out says of the estimate.
        settled: Whether the search that led to it came to its end.
        long_tails: Whether its residuals have longer tails than noise has.
        combinations: What the log tells of parameters that it leaves open.
    """
    refused = _rejected(holdout) or _contradicted(holdout)
    if refused:
        return refused
    lacking = _missing(holdout) or _mismatch(holdout) or _outside(holdout)
    lacking = lacking or (_unlike_noise(holdout) if long_tails else None)
    if lacking:
        return (_usable(holdout, lacking) if settled else None) or lacking
    return (
        _open(holdout, combinations)
        or _no_improvement(holdout)
        or (None if settled else Verdict("NO_IMPROVEMENT", f"{_how_good(holdout)}, but {UNSETTLED}"))
        or _untested(holdout)
        or _with_an_assumed_base(holdout)
        or Verdict("CALIBRATED", f"{_how_good(holdout)}, and every parameter is known to within half of its range")
    )


def _usable(holdout: HoldOut, lacking: Verdict) -> Verdict | None:
    """An estimate that predicts much better than the model as given, though the model lacks something.

    It is none where it predicts certainly worse over another time, nor at an end of its range: a wider range would give
    another one.
    """
    enough = [each for each in holdout.open_loop if each.windows >= FEWEST_GROUPS]
    better = [each for each in enough if each.relative <= MUCH_BETTER and each.relative_interval[1] < 1.0]
    if holdout.at_end or not better or any(each.relative_interval[0] > 1.0 for each in enough):
        return None
    found = max(better, key=lambda each: (not each.whole, each.seconds))  # whole runs are often few
    return Verdict(
        "USABLE",
        f"{_beside_given(found)}, so the estimates are of use in this simulator; they are not the machine's own "
        f"values, as {lacking.sentence}",
        lacking.parameters,
    )


def _beside_given(found: OpenLoop) -> str:
    """How small open-loop errors are beside those of the model as given."""
    low, high = map(_percent, found.relative_interval)
    return (
        f"over {found.seconds:.3g} s held-out motion is predicted with {_percent(found.relative)} of the error of the "
        f"model as given (95 % interval {low} to {high})"
    )


def explains_all(holdout: HoldOut) -> bool:
    """Whether an estimate's errors on the hold-out are no larger than those of noise alone, at every horizon."""
    if isinstance(holdout, ToldApart):
        return holdout.area_at_estimate.interval[0] <= 0.5
    return numerical(holdout) is not None or not beyond_noise(holdout.errors.estimate, holdout.errors.noise)


def beats_mid_range(holdout: HoldOut) -> bool:
    """Whether an estimate predicts the hold-out better than mid-range, beyond what chance may do."""
    if isinstance(holdout, ToldApart):
        return holdout.area_at_estimate.interval[1] < holdout.area_at_mid_range.area
    return holdout.errors.relative_interval[1] < 1.0


def _rejected(holdout: HoldOut) -> Verdict | None:
    if holdout.chance <= CHANCE and holdout.clearest.skill >= SKILL:
        return None
    return Verdict(
        "DATA_REJECTED",
        "next observations do not follow from their rows: the best prediction is "
        f"{100 * max(holdout.clearest.skill, 0.0):.0f} % nearer than rows paired at random "
        f"(p = {min(1.0, holdout.chance):.2g}); check the order of the rows and which columns are read",
    )


def _missing(holdout: HoldOut) -> Verdict | None:
    """A term that the model lacks and that moves the estimate, with the line that adds it to the spec."""
    term = missing_term(holdout)
    if term is None:
        return None
    value = value_of(term)
    if term.cause in DRIFTS:
        within = term.cause == WITHIN_RUNS
        change = value_of(replace(term, value=2.0 * term.value, standard_error=2.0 * term.standard_error))
        where = f"by {change} from the begin of a run to its end" if within else f"by {value} between its parts"
        return Verdict(
            "MODEL_MISMATCH",
            f"{term.parameter} drifts: it changes {'within each run' if within else 'over the log'} {where} "
            f"(t = {abs(term.t):.0f}), which is {(1 + within) * abs(term.shifts[term.parameter]):.2g} half-widths of "
            f"its interval; {WARM_UP if within else 'calibrate to each run by itself'}{about_timestep(holdout)}",
            (term.parameter,),
        )
    moved = sorted(term.shifts, key=lambda name: -abs(term.shifts[name]))[:2]
    effect = " and ".join(f"{name} by {abs(term.shifts[name]):.2g}" for name in moved)
    return Verdict(
        "MODEL_MISMATCH",
        f"the model lacks {named(term)}: a value of {value} explains {100 * term.explained:.2g} % of the squared "
        f"residuals (t = {abs(term.t):.0f}), and would move {effect} half-widths of the interval"
        f"{_others(holdout, term)}{about_timestep(holdout, term)}; {remedy(term)}{_at_end(holdout)}"
        f"{_disagreeing(holdout)}",
        tuple(moved),
    )


def _others(holdout: HoldOut, term: MissingTerm) -> str:
    """Which other terms are as likely as the one named."""
    others = list(dict.fromkeys(map(named, as_likely(holdout, term))))[:_MOST_NAMED]
    return f" ({' or '.join(others)} would explain nearly as much)" if others else ""


def _at_end(holdout: HoldOut) -> str:
    """Which estimates are at an end of their range, where other terms may make up for what lies beyond it."""
    names = ", ".join(holdout.at_end)
    return f"; {names} at the end of the range: the true value may lie beyond it, so widen it first" if names else ""


def _disagreeing(holdout: HoldOut) -> str:
    """Which parameters the parts of the log disagree on."""
    names = dict.fromkeys(name for each in holdout.alternatives if each.parts for name in each.shifts)
    return f"; parts of the log disagree on {', '.join(names)}" if names else ""


def _contradicted(holdout: HoldOut) -> Verdict | None:
    """A log that the check before the calibration found to contradict the spec."""
    if not holdout.contradictions:
        return None
    return Verdict(
        "MODEL_MISMATCH", f"the log contradicts the spec: {holdout.contradictions[0]}{about_timestep(holdout)}"
    )


def _outside(holdout: HoldOut) -> Verdict | None:
    """An estimate at the end of its range, beyond which the true value may lie."""
    if not holdout.at_end:
        return None
    return Verdict(
        "MODEL_MISMATCH",
        f"{', '.join(holdout.at_end)} at the end of the range: the true value may lie beyond it, and then the other "
        f"parameters make up for it; widen the range{about_timestep(holdout)}",
        holdout.at_end,
    )


def _unlike_noise(holdout: HoldOut) -> Verdict | None:
    """Residuals with long tails, where the error of the integration step does not explain them."""
    if numerical(holdout) is not None:
        return None
    return Verdict(
        "MODEL_MISMATCH",
        "residuals have longer tails than noise has: the model does not explain some stretches of the log, and "
        "intervals do not count that; look there for a force that acts at times only, at contacts or in fast motion, "
        f"for wrong or missing readings and for values that differ between runs{about_timestep(holdout)}",
    )


def _mismatch(holdout: HoldOut) -> Verdict | None:
    if numerical(holdout) is not None:
        return None
    at_end = [f"{', '.join(holdout.at_end)} at the end of the range"] if holdout.at_end else []
    if isinstance(holdout, ToldApart):
        sentence = _separable(holdout.area_at_mid_range, holdout.area_at_estimate, at_end)
    else:
        sentence = _systematic(holdout, at_end)
    if not sentence:
        return None
    term = likeliest([each for each in holdout.missing_terms if is_certain(each) and each.cause not in DRIFTS])
    if term is not None:
        sentence += (
            f"; of single terms {named(term)} is the likeliest: {value_of(term)} explains {100 * term.explained:.2g} % "
            f"of the squared residuals of windows with fitted starts (t = {abs(term.t):.0f}){_others(holdout, term)}; "
            f"{remedy(term)}"
        )
    return Verdict("MODEL_MISMATCH", f"{sentence}{about_timestep(holdout)}", holdout.at_end)


def _systematic(holdout: Predicted | Fitted, at_end: list[str]) -> str:
    """How the errors of the best parameters nearby differ from noise, in size and for a reason; else empty."""
    errors, direct, reasons = holdout.errors, isinstance(holdout, Predicted), list[str]()
    if holdout.explained > EXPLAINED:
        inputs = "state and action" if direct else "readings and actions"
        reasons.append(f"{inputs} explain {100 * holdout.explained:.0f} % of it")
    if isinstance(holdout, Predicted) and holdout.autocorrelation > WHITE:
        reasons.append(f"it is correlated from step to step ({holdout.autocorrelation:.2f})")
    if isinstance(holdout, Predicted) and holdout.persistence > PERSISTENT:
        lasts = f"it lasts over several rows (correlation {holdout.persistence:.2f})"
        reasons.append(f"{lasts}, as an external force does or a base that moves")
    reasons += at_end
    beyond = beyond_noise(errors.nearby_best, errors.noise)
    if not beyond or not reasons:
        return _adding_up(holdout) if isinstance(holdout, Predicted) else ""
    left, noise = max(beyond, key=lambda pair: pair[0].mean / max(pair[1].mean, NEGLIGIBLE))
    return (
        f"the best parameters nearby leave {left.mean:.2g} of the typical change in {_steps(errors.stride)} after "
        f"{_steps(left.steps)}{'' if direct else ' behind a fitted start'} on the hold-out, where noise leaves "
        f"{noise.mean:.2g}, and "
        f"{', '.join(reasons)}: the model cannot explain the data ({_change(errors)} at the estimate)"
    )


def _adding_up(holdout: Predicted) -> str:
    """Which signal's error over the longest horizon is larger than noise and random forces make it; else empty."""
    signal, factor = max(holdout.beside_random.items(), key=lambda pair: pair[1], default=("", 0.0))
    if factor <= BEYOND_RANDOM:
        return ""
    return (
        f"after {_steps(holdout.errors.nearby_best[-1].steps)} the best parameters nearby leave {factor:.2g} times or "
        f"more of the error in {signal} that sensor noise and random forces make: the model cannot explain the data "
        f"({_change(holdout.errors)} at the estimate)"
    )


def _separable(before: Area, after: Area, at_end: list[str]) -> str:
    """How well a classifier separates simulated from logged rows, if better than `SEPARABLE`; else empty."""
    if after.interval[0] <= SEPARABLE or after.area >= before.area:
        return ""
    return (
        f"a classifier still tells rows of the simulator from those held out, {_area(after)} after {_area(before)} at "
        f"mid-range (0.5 is chance){', and '.join(['', *at_end])}: the model cannot move as the data does, or the "
        "search is not at its end"
    )


def _open(holdout: HoldOut, combinations: Sequence[Combination]) -> Verdict | None:
    shares = {name: share for name, share in holdout.interval_shares.items() if share >= OPEN}
    if not shares:
        return None
    told = f"; it tells {', '.join(map(str, combinations))}" if combinations else ""
    return Verdict(
        "NOT_IDENTIFIABLE",
        f"the data leaves {', '.join(shares)} open: a 95 % interval covers {100 * min(shares.values()):.0f} % of the "
        f"range or more{told}; leave out all but one of those that act alike, or log motions that excite them",
        tuple(shares),
    )


def _untested(holdout: HoldOut) -> Verdict | None:
    if holdout.tested:
        return None
    if isinstance(holdout, ToldApart):
        why = (
            "the log tells no states, which testing whether the model lacks anything takes; log positions and "
            "velocities, or rows in their order"
        )
    else:
        why = (
            "whether the model lacks anything was not tested: the log has too few windows that the model can follow, "
            "or the budget was too short; log more, or in longer runs, or give it more time"
        )
    return Verdict("NOT_IDENTIFIABLE", f"{_how_good(holdout)}, but {why}")


def _with_an_assumed_base(holdout: HoldOut) -> Verdict | None:
    """What would be `CALIBRATED`, if contacts that stand still were not all that tells where a base is."""
    if not holdout.base_from_contacts:
        return None
    why = (
        "no sensor shows where the base is and how fast it moves: both were taken from contacts that stand still, "
        "which was not tested; log the base by motion capture, for a while at least, to be sure of the values"
    )
    found = _usable(holdout, Verdict("MODEL_MISMATCH", why))
    return found or Verdict("NOT_IDENTIFIABLE", f"{_how_good(holdout)}, but {why}")


def _no_improvement(holdout: HoldOut) -> Verdict | None:
    if isinstance(holdout, ToldApart):
        sentence = _no_better_areas(holdout.area_at_mid_range, holdout.area_at_estimate)
    else:
        sentence = "" if _mid_range_was_right(holdout) else _no_better_errors(holdout)
    return Verdict("NO_IMPROVEMENT", sentence) if sentence else None


def _mid_range_was_right(holdout: Predicted | Fitted) -> bool:
    """Whether the interval of every parameter holds mid-range, and nothing nearby explains the hold-out better."""
    inside = all(abs(value) <= holdout.interval_shares[name] for name, value in holdout.estimate.items())
    errors, noise = holdout.errors, holdout.errors.noise
    as_good = errors.nearby_relative > 1.0 - WORTH_GAINING
    other_windows = any(each.causes == (OTHER_WINDOWS,) for each in holdout.alternatives)
    beyond = beyond_noise((*errors.mid_range, *errors.estimate), (*noise, *noise))
    return inside and as_good and not other_windows and not beyond


def _no_better_errors(holdout: Predicted | Fitted) -> str:
    """Why an estimate is no improvement by its prediction errors; empty if it is one.

    A small gain is one as well if it is significant and leaves noise alone, which then is most of any error.
    """
    errors, only_noise = holdout.errors, beats_mid_range(holdout) and explains_all(holdout)
    if errors.nearby_relative > 1.0 - WORTH_GAINING and not only_noise:
        return (
            f"mid-range is as good: parameters nearby leave {100 * errors.nearby_relative:.0f} % of its error on the "
            f"hold-out ({_change(errors)} at the estimate)"
        )
    gained = (1.0 - errors.relative) / (1.0 - errors.nearby_relative)
    if errors.relative_interval[1] < 1.0 and gained >= GAINED:
        return ""
    return (
        f"{_how_small(errors)}, where parameters nearby leave {_percent(errors.nearby_relative)}: the search is not at "
        "its end; give it a larger budget or another method"
    )


def _no_better_areas(before: Area, after: Area) -> str:
    """Why an estimate is no improvement by the classifier's areas; empty if it is one."""
    if after.interval[1] < before.area and after.area < before.interval[0] and after.area <= SEPARABLE:
        return ""
    if before.area <= SEPARABLE:
        return (
            f"mid-range is as good: a classifier hardly tells its rows from those held out, {_area(before)}, nor "
            f"those of the estimate, {_area(after)} (0.5 is chance)"
        )
    return (
        f"a classifier tells rows of the simulator from those held out as well as at mid-range: {_area(after)} after "
        f"{_area(before)} (0.5 is chance)"
    )


def _how_good(holdout: HoldOut) -> str:
    if not isinstance(holdout, ToldApart):
        confirmed = ", and mid-range is confirmed: every interval holds it" if _mid_range_was_right(holdout) else ""
        parts = [each for each in holdout.open_loop if not each.whole and each.relative <= 1.0]
        told = _beside_given(parts[-1]) if parts else _how_small(holdout.errors)
        return f"{told}{', down to the noise' if explains_all(holdout) else ''}{confirmed}"
    return (
        "a classifier tells rows of the simulator from those held out with an area of "
        f"{_area(holdout.area_at_estimate)}, after {_area(holdout.area_at_mid_range)} at mid-range (0.5 is chance)"
    )


def _how_small(errors: PredictionErrors) -> str:
    low, high = map(_percent, errors.relative_interval)
    return (
        f"the prediction error on the hold-out is {_percent(errors.relative)} of mid-range's (95 % interval {low} to "
        f"{high}; {_change(errors)}, in typical changes of {_steps(errors.stride)})"
    )


def _change(errors: PredictionErrors) -> str:
    """Errors after the most steps: at mid-range, then at the estimate."""
    before, after = errors.mid_range[-1], errors.estimate[-1]
    return f"{before.mean:.2g} → {after.mean:.2g} after {_steps(after.steps)}"


def _area(area: Area) -> str:
    low, high = area.interval
    return f"{area.area:.2f} [{low:.2f}, {high:.2f}]"


def _steps(count: int) -> str:
    return "1 step" if count == 1 else f"{count} steps"


def _percent(share: float) -> str:
    return f"{100 * share:.{2 if share < 0.995 else 3}g} %" if np.isfinite(share) else "?"
