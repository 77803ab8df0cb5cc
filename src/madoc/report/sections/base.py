"""What a section of a page is, and what sections share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from madoc.calibration import ParameterEstimate
from madoc.report.reading import Run
from madoc.report.words import number

TONES: Mapping[str, str] = {
    "CALIBRATED": "good",
    "NO_IMPROVEMENT": "doubtful",
    "NOT_IDENTIFIABLE": "doubtful",
    "MODEL_MISMATCH": "bad",
    "DATA_REJECTED": "bad",
}
"""Class of the style sheet that colours each verdict."""

Shown = dict[str, object]
"""What a template shows, by name."""


@dataclass(frozen=True)
class Section:
    """One part of a page.

    Attributes:
        id: Anchor, and name of the template's block.
        title: Heading.
        lede: How to read it, a sentence or two.
        data: What the template shows; None where the run does not have it.
        absent: Why it is not there.
    """

    id: str
    title: str
    lede: str
    data: Shown | None = None
    absent: str = ""


NOT_ENDED = "The run has not ended."
"""Why what comes with the result is not there."""


def interval_words(ends: Sequence[float]) -> str:
    """An interval by its ends, or by its half-width where four digits do not tell them apart."""
    low, high = (number(end) for end in ends)
    return f"{low} to {high}" if low != high else f"± {number((ends[1] - ends[0]) / 2, 2)}"


def spread_of(row: ParameterEstimate) -> tuple[float, float]:
    """The ends of an estimate's 95 % interval; where that is not known, one standard deviation to either side."""
    if row.interval:
        return row.interval[0], row.interval[1]
    return row.estimate - row.std, row.estimate + row.std


def place(value: float, low: float, high: float) -> float:
    """Where a value stands between two ends, in %; values beyond them stand at the ends."""
    return round(min(max((value - low) / (high - low), 0.0), 1.0) * 100, 3)


def unit_words(unit: str) -> str:
    """A unit as a page shows it; that of a ratio is not shown."""
    return "" if unit == "1" else unit


def group_colour(run: Run, name: str) -> str:
    """The colour of a parameter's group."""
    return f"g{run.groups.get(name, 0) % 8}"
