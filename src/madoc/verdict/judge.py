"""The verdict: one word and one sentence with its numbers, from what the hold-out says."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from madoc.verdict.assessment import NEGLIGIBLE, Assessment

Word = Literal["CALIBRATED", "NO_IMPROVEMENT", "NOT_IDENTIFIABLE", "MODEL_MISMATCH", "DATA_REJECTED"]

WORDS: dict[Word, str] = {
    "CALIBRATED": "the hold-out is predicted better than by mid-range, about as well as parameters can",
    "NO_IMPROVEMENT": "the hold-out is predicted no better than by mid-range, or far from as well as parameters could",
    "NOT_IDENTIFIABLE": "the data leaves some parameters open",
    "MODEL_MISMATCH": "what is left over is no noise: nothing in the ranges explains the data",
    "DATA_REJECTED": "next observations do not follow from their rows",
}

CHANCE = 0.01
"""Of all ways to predict together: how often rows paired at random may do as well."""
SKILL = 0.1
"""A median error smaller by less than a tenth than at random is nothing to calibrate to, however sure it is."""
ABOVE_NOISE = 2.0
"""Times the error that noise alone leaves. The noise is known to about ±50 % from a few hundred rows."""
EXPLAINED = 0.1
"""Share of squared residuals said by state and action on unseen rows; noise alone gives at most a few percent."""
WHITE = 0.2
"""Autocorrelation past which residuals are not white: four deviations of that of 400 independent rows."""
AT_END = 0.98
"""In [-1, 1], past which a parameter is pinned at the end of its range."""
UNTOLD = 0.5
"""A 95 % interval over half of the range or more has told little: the range alone had said it to ±½."""
GAINED = 0.75
"""Share of what parameters could gain over mid-range on the hold-out that an estimate must have gained."""
WORTH_GAINING = 0.05
"""Where parameters could make mid-range's error smaller by less than this share, mid-range is as good."""
TOLD_APART = 0.65
"""Area under the curve past which a classifier tells log and simulator apart. A clone's rollouts come to about 0.55
in the true simulator."""


@dataclass(frozen=True)
class Verdict:
    """What to make of an estimate.

    Attributes:
        word: A key of `WORDS`.
        sentence: Why, with the numbers.
        parameters: Which ones are meant, if it is about some.
    """

    word: Word
    sentence: str
    parameters: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self) | {"parameters": list(self.parameters)}


def judge(found: Assessment) -> Verdict:
    """The first that applies: rejected data, a mismatch, open parameters, no improvement; else calibrated."""
    for doubt in (_rejected, _mismatch, _open, _no_better):
        verdict = doubt(found)
        if verdict is not None:
            return verdict
    return Verdict("CALIBRATED", f"{_how_good(found)}, and every parameter is told to within half of its range")


def explains_all(found: Assessment) -> bool:
    """Whether an estimate leaves of the hold-out no more than noise does, at any horizon."""
    if found.measure == "two-sample":
        return found.areas["estimate"].low <= 0.5
    left, noise = found.errors["estimate"], found.errors["noise"]
    return all(left[at] <= max(NEGLIGIBLE, ABOVE_NOISE * noise[at]) for at in left)


def _rejected(found: Assessment) -> Verdict | None:
    if found.chance <= CHANCE and found.skill >= SKILL:
        return None
    return Verdict(
        "DATA_REJECTED",
        "next observations do not follow from their rows: the best prediction is "
        f"{100 * max(found.skill, 0.0):.0f} % nearer than rows paired at random (p = {min(1.0, found.chance):.2g}); "
        "check the order of the rows and which columns are read",
    )


def _mismatch(found: Assessment) -> Verdict | None:
    pinned = _pinned(found)
    if found.measure == "two-sample":
        told, before = found.areas["estimate"], found.areas["mid-range"]
        if told.low <= TOLD_APART or told.area >= before.area:
            return None
        more = f", and {', '.join(pinned)} at the end of the range" if pinned else ""
        return Verdict(
            "MODEL_MISMATCH",
            f"a classifier still tells rows of the simulator from those held out, {_area(told)} after {_area(before)} "
            f"at mid-range (0.5 is chance){more}: the model cannot move as the data does, or the search is not at its "
            "end",
            pinned,
        )
    left, noise = found.errors["nearby best"], found.errors["noise"]
    beyond = [at for at in left if left[at] > max(NEGLIGIBLE, ABOVE_NOISE * noise[at])]
    reasons = []
    if found.explained > EXPLAINED:
        reasons.append(f"state and action explain {100 * found.explained:.0f} % of it")
    if found.autocorrelation > WHITE:
        reasons.append(f"it is correlated from step to step ({found.autocorrelation:.2f})")
    if pinned:
        reasons.append(f"{', '.join(pinned)} at the end of the range")
    if not beyond or not reasons:
        return None
    at = max(beyond, key=lambda horizon: left[horizon] / max(noise[horizon], NEGLIGIBLE))
    return Verdict(
        "MODEL_MISMATCH",
        f"the best parameters nearby leave {_size(left[at])} of a step's change after {_steps(at)} on the hold-out, "
        f"where noise leaves {_size(noise[at])}, and {', '.join(reasons)}: the model cannot explain the data "
        f"({_change(found)} at the estimate)",
        pinned,
    )


def _open(found: Assessment) -> Verdict | None:
    names = tuple(name for name, share in zip(found.names, found.shares, strict=True) if share >= UNTOLD)
    if not names:
        return None
    least = float(min(share for share in found.shares if share >= UNTOLD))
    return Verdict(
        "NOT_IDENTIFIABLE",
        f"the data leaves {', '.join(names)} open: a 95 % interval covers {100 * least:.0f} % of the range or more; "
        "leave out all but one of those that act alike, or log motions that excite them",
        names,
    )


def _no_better(found: Assessment) -> Verdict | None:
    if found.measure == "two-sample":
        told, before = found.areas["estimate"], found.areas["mid-range"]
        if told.high < before.area and told.area < before.low and told.area <= TOLD_APART:
            return None
        if before.area <= TOLD_APART:
            return Verdict(
                "NO_IMPROVEMENT",
                f"mid-range is as good: a classifier hardly tells its rows from those held out, {_area(before)}, nor "
                f"those of the estimate, {_area(told)} (0.5 is chance)",
            )
        return Verdict(
            "NO_IMPROVEMENT",
            f"a classifier tells rows of the simulator from those held out as well as at mid-range: {_area(told)} "
            f"after {_area(before)} (0.5 is chance)",
        )
    if found.best > 1.0 - WORTH_GAINING:
        return Verdict(
            "NO_IMPROVEMENT",
            f"mid-range is as good: parameters nearby leave {100 * found.best:.0f} % of its error on the hold-out "
            f"({_change(found)} at the estimate)",
        )
    gained = (1.0 - found.relative) / (1.0 - found.best)
    if found.relative_interval[1] < 1.0 and gained >= GAINED:
        return None
    return Verdict(
        "NO_IMPROVEMENT",
        f"{_how_good(found)}, where parameters nearby leave {_percent(found.best)}: the search is not at its end; give "
        "it a larger budget or another method",
    )


def _pinned(found: Assessment) -> tuple[str, ...]:
    return tuple(name for name, value in zip(found.names, found.unit, strict=True) if abs(value) > AT_END)


def _how_good(found: Assessment) -> str:
    if found.measure == "two-sample":
        told, before = found.areas["estimate"], found.areas["mid-range"]
        return (
            f"a classifier tells rows of the simulator from those held out with an area of {_area(told)}, after "
            f"{_area(before)} at mid-range (0.5 is chance)"
        )
    low, high = found.relative_interval
    return (
        f"the prediction error on the hold-out is {_percent(found.relative)} of mid-range's (95 % interval "
        f"{_percent(low)} to {_percent(high)}; {_change(found)} of a step's change)"
    )


def _change(found: Assessment) -> str:
    """Errors after the fewest and the most steps: mid-range, then the estimate."""
    before, after = found.errors["mid-range"], found.errors["estimate"]
    at = max(before)
    return f"{_size(before[at])} → {_size(after[at])} after {_steps(at)}"


def _area(told: Any) -> str:
    return f"{told.area:.2f} [{told.low:.2f}, {told.high:.2f}]"


def _steps(count: int) -> str:
    return "1 step" if count == 1 else f"{count} steps"


def _size(value: float) -> str:
    return f"{value:.2g}"


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if np.isfinite(share) else "?"
