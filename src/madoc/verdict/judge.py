"""The verdict on an estimate: one word, and a sentence with the numbers behind it.

It answers two questions: does the simulator predict, and can the numbers be believed? An estimate that predicts though
its model lacks something, or its search had not ended, is `USABLE`: its numbers serve in this simulator.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from madoc.calibration.holdout import Area, Fitted, HoldOut, OpenLoop, Predicted, PredictionErrors, ToldApart, Verdict
from madoc.identification.combinations import Combination
from madoc.identification.information import OPEN
from madoc.identification.missing_terms import OTHER_WINDOWS
from madoc.identification.term_tests import named
from madoc.verdict.adequacy import is_certain, numerical, of_timestep
from madoc.verdict.mismatch import (
    SEPARABLE,
    at_most,
    change_of,
    contradicted,
    in_percent,
    in_rows,
    lacking,
    of_area,
)
from madoc.verdict.prediction import FEWEST_WINDOWS
from madoc.verdict.statistics import ABOVE_NOISE, FEWEST_GROUPS, WORTH_GAINING, beyond_noise

UNSETTLED = "the search had not settled when its budget ended: resume it with a larger one (--resume, --budget)"
EFFECTIVE = (
    "the model leaves more than noise, and other values predict better than those that explain short windows best: it "
    "seems to lack something, whose effect the estimates make up for"
)
CHANCE = 0.01
"""Significance level in [0, 1]: data is rejected where no prediction is better than chance at this level."""
SKILL = 0.1
"""Skill of the best prediction, at most 1; data is rejected below it, however significant the prediction is."""
GAINED = 0.75
"""Share in [0, 1] of the possible gain over mid-range on the hold-out; with less, an estimate is no improvement."""
MUCH_BETTER = 0.8
"""Error of open-loop predictions over that of the model as given, at or below which an estimate is of use though the
model lacks something."""
WORSE_SIGNAL = 1.1
"""Error of one signal over that of the model as given, above which the sentence names it if it is beyond noise."""
NAMED = 3
"""Largest number of such signals that are named."""
BEYOND_RANDOM = 1.3
"""Lower end of the 95 % interval of a signal's error over that of noise, random forces and uncertainty; above it there
is something that is none of these."""
LEAST_EXPLAINED = 1e-3
"""Share in [0, 1] of the squared residuals; a term that is certain and explains less may stand for what the noise of
initial states does at contacts, as in an honest log of a puck (0.013 %)."""


def judge(
    holdout: HoldOut,
    *,
    settled: bool = True,
    unlike_noise: bool = False,
    effective: bool = False,
    in_time: bool = True,
    combinations: Sequence[Combination] = (),
) -> Verdict:
    """The first verdict that applies: rejected data, a model that lacks something, open parameters, no improvement.

    What the model lacks makes an estimate `USABLE` where it predicts much better than the model as given, and else a
    mismatch; one of a search that had not settled is `USABLE` there too, and else no improvement: what its log leaves
    open is not known before. Where nothing told whether the model lacks a term, an estimate is `USABLE` there as well,
    and else its parameters count as open.

    Args:
        holdout: What the hold-out says of the estimate.
        settled: Whether the search that led to it came to its end.
        unlike_noise: Whether its residuals have longer tails than noise has, add up, are each like the next, or follow
            from state and action.
        effective: Whether the model leaves more than noise, and the estimate is the one that predicts best with it.
        in_time: False where the budget left no time for a part of judging without which nothing is tested.
        combinations: What the log tells of parameters that it leaves open.
    """
    refused = _rejected(holdout) or contradicted(holdout)
    if refused:
        return refused
    lacks = lacking(holdout, settled=settled, unlike_noise=unlike_noise)
    if lacks:
        return (_usable(holdout, lacks) if settled else None) or lacks
    if not settled:
        return _no_improvement(holdout) or _unsettled(holdout)
    return (
        _open(holdout, combinations)
        or _no_improvement(holdout)
        or _untested(holdout, in_time=in_time)
        or _beyond_noise_later(holdout)
        or _small_but_certain(holdout)
        or (_not_certain(holdout, EFFECTIVE) if effective and not of_timestep(holdout) else None)
        or Verdict("CALIBRATED", f"{_how_good(holdout)}, and {_how_sure(holdout)}")
    )


def _how_sure(holdout: HoldOut) -> str:
    """How wide the widest interval is, as a clause."""
    widest = max(holdout.interval_shares, key=holdout.interval_shares.__getitem__)
    return f"the widest 95 % interval, of {widest}, covers {at_most(holdout.interval_shares[widest])} of its range"


def _usable(holdout: HoldOut, lacks: Verdict) -> Verdict | None:
    """An estimate that predicts much better than the model as given, though the model lacks something.

    It is none where it predicts certainly worse over another time, nor at an end of its range: a wider range would give
    another one.
    """
    better = _much_better(holdout)
    if holdout.at_end or not better:
        return None
    found = max(better, key=lambda each: (not each.whole, each.seconds))  # whole runs are often few
    return Verdict(
        "USABLE",
        f"{_beside_given(found, holdout.noise)}, so the estimates are of use in this simulator; they need not be the "
        f"machine's own values, as {lacks.sentence}",
        lacks.parameters,
    )


def _much_better(holdout: HoldOut) -> list[OpenLoop]:
    """Predictions that are much and certainly better than those of the model as given; none if others are worse."""
    enough = [each for each in holdout.open_loop if each.windows >= FEWEST_GROUPS]
    if any(each.relative_interval[0] > 1.0 for each in enough):
        return []
    return [each for each in enough if each.relative <= MUCH_BETTER and each.relative_interval[1] < 1.0]


def _beside_given(found: OpenLoop, noise: Mapping[str, float]) -> str:
    """How small open-loop errors are beside those of the model as given, and of which signals they are larger."""
    low, high = map(in_percent, found.relative_interval)
    least = {name: max(WORSE_SIGNAL * found.as_given[name], noise.get(name, 0.0)) for name in found.estimate}
    worse = [name for name, error in found.estimate.items() if error > least[name]]
    named = ", ".join(worse[:NAMED]) + (f" and {len(worse) - NAMED} more" if len(worse) > NAMED else "")
    but = f"; {named} {'is' if len(worse) == 1 else 'are'} predicted worse than by that model" if worse else ""
    return (
        f"over {found.seconds:.3g} s held-out motion is predicted with {in_percent(found.relative)} of the error of "
        f"the model as given (95 % interval {low} to {high}{but})"
    )


def explains_all(holdout: HoldOut) -> bool:
    """Whether an estimate's errors on the hold-out are no larger than those of noise alone, at every horizon."""
    if isinstance(holdout, ToldApart):
        return holdout.area_at_estimate.interval[0] <= 0.5
    noise_alone = not beyond_noise(holdout.errors.estimate, holdout.errors.noise)
    return noise_alone or of_timestep(holdout)


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


def _open(holdout: HoldOut, combinations: Sequence[Combination]) -> Verdict | None:
    in_time = holdout.open_in_time
    shares = {name: each for name, each in holdout.interval_shares.items() if each >= OPEN and name not in in_time}
    if not shares:
        return None
    told = f"; it tells {', '.join(map(str, combinations))}" if combinations else ""
    return Verdict(
        "NOT_IDENTIFIABLE",
        f"the data leaves {', '.join(shares)} open: a 95 % interval covers {100 * min(shares.values()):.0f} % of the "
        f"range or more{told}; leave out all but one of those that act alike, or log motions that excite them",
        tuple(shares),
    )


def _untested(holdout: HoldOut, *, in_time: bool) -> Verdict | None:
    if holdout.tested and not holdout.open_in_time:
        return None
    if holdout.tested:
        why = (
            "the budget left time for fewer tests than usual of what the model lacks, and what they do not exclude "
            f"leaves {', '.join(holdout.open_in_time)} open; give it a larger budget (--budget)"
        )
    elif isinstance(holdout, ToldApart):
        why = (
            "the log tells no states, which testing whether the model lacks anything takes; log positions and "
            "velocities, or rows in their order"
        )
    elif not in_time:
        why = (
            "whether the model lacks anything was not tested, as the budget left no time for that; give it a larger "
            "one (--budget)"
        )
    else:
        why = (
            "whether the model lacks anything was not tested: the log has too few windows that the model can follow, "
            "or the budget was too short; log more, or in longer runs, or give it a larger budget (--budget)"
        )
    return _not_certain(holdout, why, holdout.open_in_time if holdout.tested else ())


def _beyond_noise_later(holdout: HoldOut) -> Verdict | None:
    """What no test of single terms finds, and yet is in predictions over a longer time; whole runs are few."""
    beside = [
        (ratio, name, each.seconds)
        for each in holdout.open_loop
        for name, ratio in each.beside_noise.items()
        if each.windows >= FEWEST_GROUPS and ratio > (ABOVE_NOISE if each.whole else BEYOND_RANDOM)
    ]
    if not beside or numerical(holdout.missing_terms) is not None:
        return None
    ratio, name, seconds = max(beside)
    return _not_certain(
        holdout,
        f"the model lacks something that no test finds: over {seconds:.3g} s it predicts {name} with {ratio:.2g} times "
        "the error, at least, that noise and the estimates' uncertainty make; look for what acts slowly, "
        "or for what couples drives, as a supply that they share",
    )


def _small_but_certain(holdout: HoldOut) -> Verdict | None:
    """What is certainly missing, though it explains too little of the residuals to be named as the cause.

    Parameters may have made up for more of it than is left.
    """
    small = [term for term in holdout.missing_terms if is_certain(term) and term.explained >= LEAST_EXPLAINED]
    if not small or numerical(holdout.missing_terms) is not None:
        return None
    clearest = max(small, key=lambda term: abs(term.t))
    return _not_certain(
        holdout,
        f"the model certainly lacks something: {named(clearest)} explains only {100 * clearest.explained:.2g} % of "
        f"the squared residuals, but not by chance (t = {abs(clearest.t):.1f}), and the parameters may have absorbed "
        "most of its effect; which term it is the log does not tell, so look for what acts alike",
    )


def _unsettled(holdout: HoldOut) -> Verdict:
    """A search that had not come to its end, and may still have come far enough to be of use.

    An end of a range says nothing yet: the search may go on from there.
    """
    why = UNSETTLED if holdout.tested else f"{UNSETTLED}; nor was tested whether the model lacks anything"
    return _usable(replace(holdout, at_end=()), Verdict("NO_IMPROVEMENT", why)) or Verdict(
        "NO_IMPROVEMENT", f"{_how_good(holdout)}, but {why}"
    )


def _not_certain(holdout: HoldOut, why: str, parameters: tuple[str, ...] = ()) -> Verdict:
    """An estimate that predicts, but whose intervals do not count something."""
    found = _usable(holdout, Verdict("MODEL_MISMATCH", why, parameters))
    return found or Verdict("NOT_IDENTIFIABLE", f"{_how_good(holdout)}, but {why}", parameters)


def _no_improvement(holdout: HoldOut) -> Verdict | None:
    if isinstance(holdout, ToldApart):
        sentence = _no_better_areas(holdout.area_at_mid_range, holdout.area_at_estimate)
    else:
        improved, errors = _mid_range_was_right(holdout) or _improved_later(holdout), holdout.errors
        low, high = errors.relative_interval
        sentence = "" if improved else _no_better_errors(holdout)
        if sentence and errors.windows < FEWEST_WINDOWS and low <= 1.0 <= high:
            sentence = (
                f"{_how_small(errors)}, but the {errors.windows} windows that there were time and rows for are too few "
                "to tell whether that is chance; give it a larger budget (--budget), or hold out more (--holdout)"
            )
    return Verdict("NO_IMPROVEMENT", sentence) if sentence else None


def _mid_range_was_right(holdout: Predicted | Fitted) -> bool:
    """Whether the interval of every parameter holds mid-range, and nothing nearby explains the hold-out better."""
    inside = all(abs(value) <= holdout.interval_shares[name] for name, value in holdout.estimate.items())
    errors, noise = holdout.errors, holdout.errors.noise
    as_good = errors.nearby_relative > 1.0 - WORTH_GAINING
    other_windows = any(each.causes == (OTHER_WINDOWS,) for each in holdout.alternatives)
    beyond = beyond_noise((*errors.mid_range, *errors.estimate), (*noise, *noise))
    return inside and as_good and not other_windows and not beyond


def _improved_later(holdout: Predicted | Fitted) -> bool:
    """Whether noise hides within a few rows what parameters do, and later errors are much smaller than at mid-range.

    Slow robots need longer to go elsewhere. Errors are those of noise then, no parameters nearby leave less of
    mid-range's error, which is not certainly exceeded, and over no length are those of the model as given.
    """
    errors, enough = holdout.errors, [each for each in holdout.open_loop if each.windows >= FEWEST_GROUPS]
    hidden = errors.nearby_relative > 1.0 - WORTH_GAINING and errors.relative_interval[0] <= 1.0
    if not (hidden and explains_all(holdout)) or any(each.relative_interval[0] > 1.0 for each in enough):
        return False
    pairs = ([(error, each.mid_range[name]) for name, error in each.estimate.items()] for each in enough)
    moving = ([error / before for error, before in each if before > 0.0] for each in pairs)
    return any(np.mean(ratios) <= 1.0 - GAINED for ratios in moving if ratios)


def _no_better_errors(holdout: Predicted | Fitted) -> str:
    """Why an estimate is no improvement by its prediction errors; empty if it is one.

    A small gain is one as well if it is significant and leaves noise alone, which then is most of any error; and one
    that is not significant, if it leaves noise alone and predictions over some time are much better than as given.
    """
    errors, only_noise = holdout.errors, beats_mid_range(holdout) and explains_all(holdout)
    if errors.nearby_relative > 1.0 - WORTH_GAINING and not only_noise:
        return (
            f"mid-range is as good: parameters nearby leave {100 * errors.nearby_relative:.0f} % of its error on the "
            f"hold-out ({change_of(errors)})"
        )
    gained = (1.0 - errors.relative) / (1.0 - errors.nearby_relative)
    certain = errors.relative_interval[1] < 1.0 or (explains_all(holdout) and bool(_much_better(holdout)))
    if certain and gained >= GAINED:
        return ""
    return (
        f"{_how_small(errors)}, where parameters nearby leave {in_percent(errors.nearby_relative)}: the search is not "
        "at its end; give it a larger budget (--budget) or another method (--method)"
    )


def _no_better_areas(before: Area, after: Area) -> str:
    """Why an estimate is no improvement by the classifier's areas; empty if it is one."""
    if after.interval[1] < before.area and after.area < before.interval[0] and after.area <= SEPARABLE:
        return ""
    if before.area <= SEPARABLE:
        return (
            f"mid-range is as good: a classifier hardly tells its rows from those held out, {of_area(before)}, nor "
            f"those of the estimate, {of_area(after)} (0.5 is chance)"
        )
    return (
        f"a classifier tells rows of the simulator from those held out as well as at mid-range: {of_area(after)} after "
        f"{of_area(before)} (0.5 is chance)"
    )


def _how_good(holdout: HoldOut) -> str:
    if not isinstance(holdout, ToldApart):
        right = _mid_range_was_right(holdout) and not holdout.open_in_time
        confirmed = ", and mid-range is confirmed: every interval holds it" if right else ""
        told = _how_small(holdout.errors) if holdout.ahead is None else _beside_given(holdout.ahead, holdout.noise)
        ahead = f", over the first {in_rows(holdout.errors.estimate[-1].steps)} with errors of the noise's size"
        noise_alone = not beyond_noise(holdout.errors.estimate, holdout.errors.noise)
        return f"{told}{ahead if noise_alone else ''}{confirmed}"
    return (
        "a classifier tells rows of the simulator from those held out with an area of "
        f"{of_area(holdout.area_at_estimate)}, after {of_area(holdout.area_at_mid_range)} at mid-range (0.5 is chance)"
    )


def _how_small(errors: PredictionErrors) -> str:
    low, high = map(in_percent, errors.relative_interval)
    return (
        f"the prediction error on the hold-out is {in_percent(errors.relative)} of mid-range's (95 % interval {low} to "
        f"{high}; {change_of(errors)})"
    )
