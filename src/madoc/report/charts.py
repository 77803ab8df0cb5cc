"""Charts as SVG: drawn here, so that a page needs no script to show them, prints, and follows its colour scheme.

Colours are classes of the style sheet, never values.
"""

import json
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from markupsafe import Markup, escape
from numpy.typing import ArrayLike

from madoc.report.words import number

WIDTH = 340
"""Units of a chart; about the pixels it has on a page, so that its words have the size they say."""
POINTS = 240
"""Largest number of points of a line; longer ones are thinned."""
Scale = Callable[[ArrayLike], np.ndarray]
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 8, 8, 34


@dataclass(frozen=True)
class Line:
    """One line of a chart.

    Attributes:
        name: For the legend.
        y: Values; NaN breaks the line.
        colour: Class that says the colour.
        low: Lower end of a band around it.
        high: Upper end of it.
        dashed: Drawn with gaps.
    """

    name: str
    y: Float[np.ndarray, " points"]
    colour: str
    low: Float[np.ndarray, " points"] | None = None
    high: Float[np.ndarray, " points"] | None = None
    dashed: bool = False


@dataclass(frozen=True)
class Level:
    """A horizontal line to compare with: the truth, chance."""

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
    height: int = 190,
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
        height: In the units of `WIDTH`.
        log: The vertical axis in powers of ten; values that are not positive are left out.
    """
    low, high = y_range or _extent(lines, levels, log)
    right, base = WIDTH - _RIGHT, height - _BOTTOM
    to_x, to_y = _scale(float(x[0]), float(x[-1]), _LEFT, right), _scale(low, high, base, _TOP, log=log)
    across = to_x(x)
    parts = []
    for mark in _decades(low, high) if log else ticks(low, high, 4):
        at = float(to_y(mark))
        if _TOP - 1 <= at <= base + 1:
            parts.append(f'<line class="grid" x1="{_LEFT}" x2="{right}" y1="{at:.1f}" y2="{at:.1f}"/>')
            parts.append(
                f'<text class="tick" x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{number(mark, 3)}</text>'
            )
    parts.append(f'<line class="base" x1="{_LEFT}" x2="{right}" y1="{base}" y2="{base}"/>')
    for mark in ticks(float(x[0]), float(x[-1]), 5):
        at = float(to_x(mark))
        anchor = "end" if at > right - 14 else "middle"
        parts.append(f'<text class="tick" x="{at:.1f}" y="{base + 15}" text-anchor="{anchor}">{x_words(mark)}</text>')
    middle = (_LEFT + right) / 2
    parts.append(f'<text class="axis" x="{middle}" y="{height - 4}" text-anchor="middle">{escape(x_title)}</text>')
    inside = [
        _band(across, to_y(line.low), to_y(line.high), line.colour)
        for line in lines
        if line.low is not None and line.high is not None
    ]
    for level in levels:
        if low <= level.value <= high:
            at = float(to_y(level.value))
            inside.append(f'<line class="level {level.colour}" x1="{_LEFT}" x2="{right}" y1="{at:.1f}" y2="{at:.1f}"/>')
    for line in lines:
        dashes = " dashed" if line.dashed else ""
        inside.append(f'<path class="line {line.colour}{dashes}" d="{_path(across, to_y(line.y))}"/>')
    left, top, wide, tall = _LEFT - 2, _TOP - 2, right - _LEFT + 4, base - _TOP + 4
    frame = f'x="{left}" y="{top}" width="{wide}" height="{tall}" viewBox="{left} {top} {wide} {tall}"'
    parts.append(f'<svg {frame}>{"".join(inside)}</svg><line class="pointer" y1="{_TOP}" y2="{base}"/>')
    values: dict[str, object] = {
        "x": [_rounded(value) for value in x],
        "at": [round(float(value), 1) for value in across],
        "title": x_title,
        "lines": [[line.name, line.colour, [_rounded(value) for value in line.y]] for line in lines],
    }
    return _svg("".join(parts), label, height, values)


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
    """Named points; those of one colour hang together by a thread to their middle."""
    spans = np.ptp(points, axis=0)
    margin = np.maximum(0.14 * spans, 0.05 * max(float(spans.max()), 1e-9))
    low, high = points.min(0) - margin, points.max(0) + margin
    to_x, to_y = _scale(low[0], high[0], 24, width - 24), _scale(low[1], high[1], height - 30, 14)
    at = np.column_stack([to_x(points[:, 0]), to_y(points[:, 1])])
    parts = [f'<rect class="frame" x="24" y="14" width="{width - 48}" height="{height - 44}" rx="6"/>']
    for colour in dict.fromkeys(colours):
        own = at[[index for index, each in enumerate(colours) if each == colour]]
        centre = own.mean(0)
        parts += [
            f'<line class="thread {colour}" x1="{centre[0]:.1f}" y1="{centre[1]:.1f}" x2="{x:.1f}" y2="{y:.1f}"/>'
            for x, y in own
        ]
    boxes: list[Box] = [(x - 8, y - 8, x + 8, y + 8) for x, y in at]
    for (x, y), name, colour in zip(at, names, colours, strict=True):
        left, top = _free_place(x, y, 7.0 * len(name), boxes, (width, height))
        boxes.append(_name_box(left, top, 7.0 * len(name)))
        parts.append(f'<circle class="dot {colour}" cx="{x:.1f}" cy="{y:.1f}" r="6.5"/>')
        parts.append(f'<text class="name" x="{left:.1f}" y="{top:.1f}">{escape(name)}</text>')
    parts.append(f'<text class="axis" x="{width / 2}" y="{height - 8}" text-anchor="middle">{escape(titles[0])}</text>')
    parts.append(
        f'<text class="axis" transform="translate(13 {height / 2}) rotate(-90)" text-anchor="middle">'
        f"{escape(titles[1])}</text>"
    )
    return _svg("".join(parts), label, height, None, width)


def matrix_chart(values: Float[np.ndarray, "d d"], names: Sequence[str], *, label: str) -> Markup:
    """The lower half of a symmetric matrix in [-1, 1]; each name stands where its row ends and its column begins."""
    count = len(names)
    wide, high = (48.0, 32.0) if count <= 12 else (30.0, 24.0)
    width = wide * (count - 1) + 7.6 * max(len(name) for name in names) + 16
    parts = []
    for row, name in enumerate(names):
        middle = high * (row + 0.5)
        for column in range(row):
            value = float(values[row, column])
            place = (
                f'x="{wide * column + 1:.1f}" y="{high * row + 1:.1f}" width="{wide - 2:.1f}" height="{high - 2:.1f}"'
            )
            side = "plus" if value >= 0 else "minus"
            parts.append(
                f"<g><title>{escape(name)} and {escape(names[column])}: {number(value, 3)}</title>"
                f'<rect class="cell" {place} rx="4"/>'
                f'<rect class="{side}" {place} rx="4" style="opacity:{min(abs(value), 1.0):.3f}"/>'
            )
            if count <= 12:
                strong = " strong" if abs(value) > 0.55 else ""
                parts.append(
                    f'<text class="value{strong}" x="{wide * (column + 0.5):.1f}" y="{middle + 4:.1f}" '
                    f'text-anchor="middle">{f"{value:.2f}".replace("-", "−")}</text>'
                )
            parts.append("</g>")
        parts.append(f'<text class="name" x="{wide * row + 8:.1f}" y="{middle + 4.5:.1f}">{escape(name)}</text>')
    return _svg("".join(parts), label, high * count, None, width)


def thinned(
    x: Float[np.ndarray, " lines"], y: Float[np.ndarray, " lines"], points: int = POINTS
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]:
    """At most so many points: means of neighbours, and their least and greatest; no such ends where all points fit."""
    if len(x) <= points:
        return x, y, None, None
    pieces = np.array_split(np.arange(len(x)), points)
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of pieces with no number in them
        mean, low, high = (
            np.array([statistic(y[piece]) for piece in pieces]) for statistic in (np.nanmean, np.nanmin, np.nanmax)
        )
    return np.array([x[piece].mean() for piece in pieces]), mean, low, high


def ticks(low: float, high: float, wanted: int) -> list[float]:
    """Round numbers in [low, high], about as many as wanted: multiples of 1, 2 or 5 times a power of ten."""
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
    """The range that holds all that is drawn, with some air."""
    arrays = [each for line in lines for each in (line.y, line.low, line.high) if each is not None]
    values = np.concatenate([*arrays, [level.value for level in levels]])
    values = values[np.isfinite(values) & ((values > 0) | (not log))]
    if not len(values):
        return (0.1, 1.0) if log else (0.0, 1.0)
    low, high = float(values.min()), float(values.max())
    if log:
        return low / 1.3, high * 1.3 if high > low else low * 10
    air = 0.06 * (high - low) or 0.5 * abs(high) or 0.5
    return low - air, high + air


def _scale(low: float, high: float, start: float, end: float, *, log: bool = False) -> Scale:
    """The affine map of [low, high], or of its logarithm, to [start, end]; NaN where there is no logarithm."""

    def moved(values: ArrayLike) -> np.ndarray:
        values = np.asarray(values, float)
        return np.log10(np.where(values > 0, values, np.nan)) if log else values

    first, last = moved([low, high])
    return lambda values: start + (moved(values) - first) / ((last - first) or 1.0) * (end - start)


def _path(across: np.ndarray, down: np.ndarray) -> str:
    """A path that is broken where a value is missing."""
    pieces, pen = [], "M"
    for x, y in zip(across, down, strict=True):
        if math.isfinite(y):
            pieces.append(f"{pen}{x:.1f} {min(max(y, -2000), 2000):.1f}")
        pen = "L" if math.isfinite(y) else "M"
    return "".join(pieces)


def _band(across: np.ndarray, low: np.ndarray, high: np.ndarray, colour: str) -> str:
    known = np.isfinite(low) & np.isfinite(high)
    if not known.any():
        return ""
    upper, lower = (
        [f"{x:.1f} {y:.1f}" for x, y in zip(across[known], ends[known], strict=True)] for ends in (high, low)
    )
    return f'<path class="band {colour}" d="M{"L".join([*upper, *reversed(lower)])}Z"/>'


_PLACES = ((1, 12, 4), (-1, 12, 4), (0, 0, -13), (0, 0, 22), *((side, 10, dy) for side in (1, -1) for dy in (-10, 18)))
_PLACES += tuple((side, 12, dy) for side in (1, -1) for dy in (-26, 34))
"""Where a name may stand beside its point, the best first: to its right (1), to its left or centred; how far to the
side, and how far down."""
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


def _svg(content: str, label: str, height: float, values: dict[str, object] | None, width: float = WIDTH) -> Markup:
    data = "" if values is None else f" data-told='{escape(json.dumps(values, ensure_ascii=False))}'"
    return Markup(
        f'<svg class="chart" style="--wide:{width:.0f}" viewBox="0 0 {width:.0f} {height:.0f}" role="img" '
        f'aria-label="{escape(label)}"{data}>'
        f"{content}</svg>"
    )
