"""What a section of a page is, and what sections share."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from madoc.report.reading import Run
from madoc.report.words import number

TONES = {
    "CALIBRATED": "good",
    "NO_IMPROVEMENT": "doubtful",
    "NOT_IDENTIFIABLE": "doubtful",
    "MODEL_MISMATCH": "bad",
    "DATA_REJECTED": "bad",
}
"""How a verdict is coloured."""


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
    data: Any = None
    absent: str = ""


NOT_ENDED = "The run has not ended."
"""Why what comes with the result is not there."""


def span_words(ends: Sequence[float]) -> str:
    """An interval by its ends, or by its half-width where four digits do not tell them apart."""
    low, high = (number(end) for end in ends)
    return f"{low} to {high}" if low != high else f"± {number((ends[1] - ends[0]) / 2, 2)}"


def group_colour(run: Run, name: str) -> str:
    """The colour of a parameter's group."""
    return f"g{run.groups.get(name, 0) % 8}"
