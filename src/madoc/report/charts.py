"""Charts as SVG, with `templates/charts.svg`: a page shows them without a script, and prints them.

Colours are classes of the style sheet, so that a chart follows the page's colour scheme.
"""

import json
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from markupsafe import Markup
from numpy.typing import ArrayLike

from madoc.report.rendering import chart
from madoc.report.words import number

WIDTH = 340
"""Width of a chart in its own units: about its pixels on a page, so that font sizes are what they say."""
_HEIGHT = 190
"""Height of a chart of lines in the same units."""
POINTS = 240
"""Largest number of points of a line; a longer line is thinned."""
Scale = Callable[[ArrayLike], np.ndarray]
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 8, 8, 34


@dataclass(frozen=True)
class Line:
    """One line of a chart, in the colour of a class; NaN breaks it, `low` and `high` are the ends of a band around."""

    name: str
    y: Float[np.ndarray, " points"]
    colour: str
    low: Float[np.ndarray, " points"] | None = None
    high: Float[np.ndarray, " points"] | None = None
    dashed: bool = False


@dataclass(frozen=True)
class Level:
    """A horizontal line to compare with, such as the truth or chance."""

    value: float
    name: str
    colour: str = "truth"


def line_chart(
    x: Float[np.ndarray, " points"],
    lines: Sequence[Line],
    *,
    label: str,
    x_title: str,
    x_words: Callable[[float], str] = number,
    y_range: tuple[float, float] | None = None,
    levels: Sequence[Level] = (),
    log: bool = False,
) -> Markup:
    """Lines over a shared axis; the page's script shows the values under a reader's pointer.

    Args:
        x: Ascending.
        lines: What is drawn, the last on top.
        label: What it shows, for those who cannot see it.
        x_title: Under the axis.
        x_words: How its ticks are written.
        y_range: Of the vertical axis; None fits what is drawn.
        levels: Horizontal lines.
        log: The vertical axis in powers of ten; values that are not positive are left out.
    """
    low, high = y_range or _extent(lines, levels, log)
    right, base = WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    to_x, to_y = _scale(float(x[0]), float(x[-1]), _LEFT, right), _scale(low, high, base, _TOP, log=log)
    across = to_x(x)
    heights = [(float(to_y(mark)), number(mark, 3)) for mark in (_decades(low, high) if log else ticks(low, high, 4))]
    values = {
        "x": [_rounded(value) for value in x],
        "at": [round(float(value), 1) for value in across],
        "title": x_title,
        "lines": [[line.name, line.colour, [_rounded(value) for value in line.y]] for line in lines],
    }
    return chart(
        "line",
        label=label,
        width=WIDTH,
        height=_HEIGHT,
        values=json.dumps(values, ensure_ascii=False),
        left=_LEFT,
        top=_TOP,
        right=right,
        base=base,
        x_ticks=[(float(to_x(mark)), x_words(mark)) for mark in ticks(float(x[0]), float(x[-1]), 5)],
        y_ticks=[(at, words) for at, words in heights if _TOP - 1 <= at <= base + 1],
        x_title=x_title,
        levels=[(level, float(to_y(level.value))) for level in levels if low <= level.value <= high],
        lines=[(line, _band(across, line, to_y), _path(across, to_y(line.y))) for line in lines],
    )


def scatter_chart(
    points: Float[np.ndarray, "points 2"],
    names: Sequence[str],
    colours: Sequence[str],
    *,
    label: str,
    titles: tuple[str, str],
    height: int = 420,
    width: int = 640,
) -> Markup:
    """Named points; a thread leads from each to the mean of the points of its colour."""
    spans = np.ptp(points, axis=0)
    margin = np.maximum(0.14 * spans, 0.05 * max(float(spans.max()), 1e-9))
    low, high = points.min(0) - margin, points.max(0) + margin
    to_x, to_y = _scale(low[0], high[0], 24, width - 24), _scale(low[1], high[1], height - 30, 14)
    at = np.column_stack([to_x(points[:, 0]), to_y(points[:, 1])])
    threads = []
    for colour in dict.fromkeys(colours):
        own = at[[index for index, each in enumerate(colours) if each == colour]]
        threads += [(colour, own.mean(0), end) for end in own]
    dots = []
    boxes: list[Box] = [(x - 8, y - 8, x + 8, y + 8) for x, y in at.tolist()]
    for (x, y), name, colour in zip(at.tolist(), names, colours, strict=True):
        place = _free_place(x, y, 7.0 * len(name), boxes, (width, height))
        boxes.append(_name_box(*place, 7.0 * len(name)))
        dots.append((colour, (x, y), name, place))
    return chart("scatter", label=label, width=width, height=height, threads=threads, dots=dots, titles=titles)


def matrix_chart(values: Float[np.ndarray, "d d"], names: Sequence[str], *, label: str) -> Markup:
    """The lower half of a symmetric matrix in [-1, 1]; each name stands where its row ends and its column begins."""
    wide, high = (48.0, 32.0) if len(names) <= 12 else (30.0, 24.0)
    width = wide * (len(names) - 1) + 7.6 * max(map(len, names)) + 16
    size = {"width": width, "height": high * len(names), "wide": wide, "high": high}
    return chart("matrix", label=label, values=values.tolist(), names=names, **size)


def thinned(
    x: Float[np.ndarray, " lines"], y: Float[np.ndarray, " lines"], points: int = POINTS
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]:
    """At most `points` means of neighbours, and their minima and maxima; these are None where all points fit."""
    if len(x) <= points:
        return x, y, None, None
    pieces = np.array_split(np.arange(len(x)), points)
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of pieces with no number in them
        mean, low, high = (
            np.array([statistic(y[piece]) for piece in pieces]) for statistic in (np.nanmean, np.nanmin, np.nanmax)
        )
    return np.array([x[piece].mean() for piece in pieces]), mean, low, high


def ticks(low: float, high: float, wanted: int) -> list[float]:
    """About `wanted` round numbers in [low, high]: multiples of 1, 2 or 5 times a power of ten."""
    if not high > low:
        return [low]
    step = (high - low) / wanted
    size = 10.0 ** math.floor(math.log10(step))
    step = next(size * factor for factor in (1, 2, 5, 10) if size * factor >= step * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [round(step * index, 12) + 0.0 for index in range(first, math.floor(high / step + 1e-9) + 1)]


def _decades(low: float, high: float) -> list[float]:
    first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
    if last - first < 2:
        steps = [10.0**power * digit for power in range(first - 1, last + 1) for digit in (1, 2, 5)]
        return [step for step in steps if low <= step <= high]
    step = max(1, math.ceil((last - first) / 4))
    return [10.0**power for power in range(first, last + 1, step)]


def _extent(lines: Sequence[Line], levels: Sequence[Level], log: bool) -> tuple[float, float]:
    """The range of everything that is drawn, with a margin."""
    arrays = [each for line in lines for each in (line.y, line.low, line.high) if each is not None]
    values = np.concatenate([*arrays, [level.value for level in levels]])
    values = values[np.isfinite(values) & ((values > 0) | (not log))]
    if not len(values):
        return (0.1, 1.0) if log else (0.0, 1.0)
    low, high = float(values.min()), float(values.max())
    if log:
        return low / 1.3, high * 1.3 if high > low else low * 10
    margin = 0.06 * (high - low) or 0.5 * abs(high) or 0.5
    return low - margin, high + margin


def _scale(low: float, high: float, start: float, end: float, *, log: bool = False) -> Scale:
    """The affine map of [low, high], or of its logarithm, to [start, end]; NaN where there is no logarithm."""

    def to_axis(values: ArrayLike) -> np.ndarray:
        values = np.asarray(values, float)
        return np.asarray(np.log10(np.where(values > 0, values, np.nan)) if log else values)

    first, last = to_axis(low), to_axis(high)
    return lambda values: np.asarray(start + (to_axis(values) - first) / ((last - first) or 1.0) * (end - start))


def _path(across: np.ndarray, down: np.ndarray) -> str:
    """A path that is broken where a value is missing."""
    pieces, pen = [], "M"
    for x, y in zip(across, down, strict=True):
        if math.isfinite(y):
            pieces.append(f"{pen}{x:.1f} {min(max(y, -2000), 2000):.1f}")
        pen = "L" if math.isfinite(y) else "M"
    return "".join(pieces)


def _band(across: np.ndarray, line: Line, to_y: Scale) -> str:
    """The outline of a line's band; empty where it has none."""
    if line.low is None or line.high is None:
        return ""
    low, high = to_y(line.low), to_y(line.high)
    finite = np.isfinite(low) & np.isfinite(high)
    if not finite.any():
        return ""
    upper, lower = (
        [f"{x:.1f} {y:.1f}" for x, y in zip(across[finite], ends[finite], strict=True)] for ends in (high, low)
    )
    return f"M{'L'.join([*upper, *reversed(lower)])}Z"


_PLACES = ((1, 12, 4), (-1, 12, 4), (0, 0, -13), (0, 0, 22), *((side, 10, dy) for side in (1, -1) for dy in (-10, 18)))
_PLACES += tuple((side, 12, dy) for side in (1, -1) for dy in (-26, 34))
"""Places of a name beside its point, the best first: the side (1 right, 0 centred), and offsets across and down."""
Box = tuple[float, float, float, float]


def _free_place(
    x: float, y: float, width: float, taken: Sequence[Box], size: tuple[float, float]
) -> tuple[float, float]:
    """Where a name of that width goes beside its point: the first place that overlaps nothing, else the least bad."""

    def overlap(place: tuple[float, float]) -> float:
        box = _name_box(*place, width)
        outside = max(0.0, 26 - box[0]) + max(0.0, box[2] - size[0] + 26)
        outside += max(0.0, 14 - box[1]) + max(0.0, box[3] - size[1] + 32)
        shared = sum(
            max(0.0, min(box[2], other[2]) - max(box[0], other[0]))
            * max(0.0, min(box[3], other[3]) - max(box[1], other[1]))
            for other in taken
        )
        return shared + 100.0 * outside

    lefts = {1: 0.0, -1: -width, 0: -width / 2}
    return min(((x + side * dx + lefts[side], y + dy) for side, dx, dy in _PLACES), key=overlap)


def _name_box(left: float, base: float, width: float) -> Box:
    return left, base - 13, left + width, base + 3


def _rounded(value: float) -> float | None:
    return float(f"{value:.4g}") if math.isfinite(value) else None
