"""Charts as SVG: drawn here, so that a page needs no script to show them, prints, and follows its colour scheme.

Colours are classes of the style sheet, never values.
"""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from markupsafe import Markup, escape

from madoc.report.words import number

WIDTH = 340
"""Units of a chart; about the pixels it has on a page, so that its words have the size they say."""
POINTS = 240
"""A line has at most so many points."""
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
    """Lines over a shared axis; a reader's pointer is told the values by the page's script.

    Args:
        x: Ascending.
        lines: What is drawn, the last on top.
        label: What it shows, for those who cannot see it.
        x_title: Under the axis.
        x_words: How its ticks are written.
        y_range: Of the axis; None fits what is drawn.
        levels: Horizontal lines.
        height: Units.
        log: The vertical axis in powers of ten; values that are not positive are left out.
    """
    low, high = y_range or _extent([*lines], levels, log)
    to_x = _scale(float(x[0]), float(x[-1]), _LEFT, WIDTH - _RIGHT)
    across = np.array([to_x(value) for value in x])
    vertical = _scale(math.log10(low), math.log10(high), height - _BOTTOM, _TOP) if log else None
    linear = _scale(low, high, height - _BOTTOM, _TOP)

    def to_y(value: float) -> float:
        if vertical is not None:
            return vertical(math.log10(value)) if value > 0 else math.nan
        return linear(value)

    marks = _decades(low, high) if log else ticks(low, high, 4)
    parts = [_grid(marks, to_y, height, log)]
    parts += [_x_axis(x, to_x, x_title, x_words, height)]
    inside = [_band(across, line, to_y) for line in lines if line.low is not None and line.high is not None]
    for level in levels:
        if low <= level.value <= high:
            at = to_y(level.value)
            inside.append(
                f'<line class="level {level.colour}" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>'
            )
    for line in lines:
        dashes = " dashed" if line.dashed else ""
        inside.append(f'<path class="line {line.colour}{dashes}" d="{_path(across, [to_y(y) for y in line.y])}"/>')
    frame = f"{_LEFT - 2} {_TOP - 2} {WIDTH - _LEFT - _RIGHT + 4} {height - _TOP - _BOTTOM + 4}"
    left, top, wide, tall = frame.split()
    parts.append(f'<svg x="{left}" y="{top}" width="{wide}" height="{tall}" viewBox="{frame}">{"".join(inside)}</svg>')
    told = {
        "x": [_rounded(value) for value in x],
        "at": [round(float(value), 1) for value in across],
        "title": x_title,
        "lines": [[line.name, line.colour, [_rounded(value) for value in line.y]] for line in lines],
    }
    parts.append(f'<line class="pointer" y1="{_TOP}" y2="{height - _BOTTOM}"/>')
    return _svg("".join(parts), label, height, told)


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
    to_x = _scale(low[0], high[0], 24, width - 24)
    to_y = _scale(low[1], high[1], height - 30, 14)
    at = np.array([[to_x(x), to_y(y)] for x, y in points])
    parts = [f'<rect class="frame" x="24" y="14" width="{width - 48}" height="{height - 44}" rx="6"/>']
    for colour in dict.fromkeys(colours):
        own = at[[index for index, each in enumerate(colours) if each == colour]]
        centre = own.mean(0)
        parts += [
            f'<line class="thread {colour}" x1="{centre[0]:.1f}" y1="{centre[1]:.1f}" x2="{x:.1f}" y2="{y:.1f}"/>'
            for x, y in own
        ]
    boxes: list[tuple[float, float, float, float]] = [(x - 8, y - 8, x + 8, y + 8) for x, y in at]
    for (x, y), name, colour in zip(at, names, colours, strict=True):
        left, top = _free_place(x, y, 7.0 * len(name), boxes, (width, height))
        boxes.append((left, top - 13, left + 7.0 * len(name), top + 3))
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
    """At most so many points: means of neighbours, and the least and greatest of them; none of these where all fit."""
    if len(x) <= points:
        return x, y, None, None
    pieces = np.array_split(np.arange(len(x)), points)
    means = np.array([_quiet(np.nanmean, y[piece]) for piece in pieces])
    low = np.array([_quiet(np.nanmin, y[piece]) for piece in pieces])
    high = np.array([_quiet(np.nanmax, y[piece]) for piece in pieces])
    return np.array([x[piece].mean() for piece in pieces]), means, low, high


def ticks(low: float, high: float, wanted: int) -> list[float]:
    """Round numbers in [low, high], about as many as wanted: multiples of 1, 2 or 5 times a power of ten."""
    if not high > low:
        return [low]
    step = (high - low) / wanted
    size = 10.0 ** math.floor(math.log10(step))
    step = next(size * factor for factor in (1, 2, 5, 10) if size * factor >= step * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [round(step * index, 12) + 0.0 for index in range(first, math.floor(high / step + 1e-9) + 1)]


def _quiet(statistic: Callable[[np.ndarray], Any], values: np.ndarray) -> float:
    """A statistic that passes over NaN; NaN where there is nothing else."""
    return float(statistic(values)) if np.isfinite(values).any() else math.nan


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


def _scale(low: float, high: float, start: float, end: float) -> Callable[[float], float]:
    """The affine map of [low, high] to [start, end]."""
    span = (high - low) or 1.0
    return lambda value: start + (value - low) / span * (end - start)


def _grid(marks: Sequence[float], to_y: Callable[[float], float], height: int, log: bool) -> str:
    parts = []
    for mark in marks:
        at = to_y(mark)
        if _TOP - 1 <= at <= height - _BOTTOM + 1:
            words = number(mark, 3) if not log else _power(mark)
            parts.append(f'<line class="grid" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>')
            parts.append(f'<text class="tick" x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{words}</text>')
    return "".join(parts)


def _power(value: float) -> str:
    return number(value, 3) if 1e-3 <= value < 1e4 else number(value, 2).replace("1.·", "").replace("1·", "")


def _x_axis(
    x: np.ndarray, to_x: Callable[[float], float], title: str, words: Callable[[float], str], height: int
) -> str:
    base = height - _BOTTOM
    parts = [f'<line class="base" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{base}" y2="{base}"/>']
    for mark in ticks(float(x[0]), float(x[-1]), 5):
        at = to_x(mark)
        anchor = "end" if at > WIDTH - _RIGHT - 14 else "middle"
        parts.append(f'<text class="tick" x="{at:.1f}" y="{base + 15}" text-anchor="{anchor}">{words(mark)}</text>')
    middle = (_LEFT + WIDTH - _RIGHT) / 2
    parts.append(f'<text class="axis" x="{middle}" y="{height - 4}" text-anchor="middle">{escape(title)}</text>')
    return "".join(parts)


def _path(across: np.ndarray, down: Sequence[float]) -> str:
    """A path that is broken where a value is missing."""
    pieces, pen = [], "M"
    for x, y in zip(across, down, strict=True):
        if math.isfinite(y):
            pieces.append(f"{pen}{x:.1f} {min(max(y, -2000), 2000):.1f}")
            pen = "L"
        else:
            pen = "M"
    return "".join(pieces)


def _band(across: np.ndarray, line: Line, to_y: Callable[[float], float]) -> str:
    known = np.isfinite(line.low) & np.isfinite(line.high)  # type: ignore[arg-type]
    if not known.any():
        return ""
    upper = [f"{x:.1f} {to_y(y):.1f}" for x, y in zip(across[known], line.high[known], strict=True)]  # type: ignore[index]
    lower = [f"{x:.1f} {to_y(y):.1f}" for x, y in zip(across[known], line.low[known], strict=True)]  # type: ignore[index]
    return f'<path class="band {line.colour}" d="M{"L".join([*upper, *reversed(lower)])}Z"/>'


def _free_place(
    x: float,
    y: float,
    width: float,
    taken: Sequence[tuple[float, float, float, float]],
    size: tuple[float, float],
) -> tuple[float, float]:
    """Where a name of that width goes beside its point: the first place that overlaps nothing, else the least bad."""
    sides = [(12.0, 4.0), (-12.0 - width, 4.0), (-width / 2, -13.0), (-width / 2, 22.0)]
    sides += [(10.0, dy) for dy in (-10.0, 18.0)] + [(-10.0 - width, dy) for dy in (-10.0, 18.0)]
    sides += [(12.0, dy) for dy in (-26.0, 34.0)] + [(-12.0 - width, dy) for dy in (-26.0, 34.0)]

    def overlap(place: tuple[float, float]) -> float:
        left, base = x + place[0], y + place[1]
        box = (left, base - 13, left + width, base + 3)
        outside = max(0.0, 26 - box[0]) + max(0.0, box[2] - size[0] + 26) + max(0.0, 14 - box[1])
        outside += max(0.0, box[3] - size[1] + 32)
        shared = sum(
            max(0.0, min(box[2], other[2]) - max(box[0], other[0]))
            * max(0.0, min(box[3], other[3]) - max(box[1], other[1]))
            for other in taken
        )
        return shared + 100.0 * outside

    best = min(sides, key=overlap)
    return x + best[0], y + best[1]


def _rounded(value: float) -> float | None:
    return float(f"{value:.4g}") if math.isfinite(value) else None


def _svg(content: str, label: str, height: float, told: dict[str, Any] | None, width: float = WIDTH) -> Markup:
    data = "" if told is None else f" data-told='{escape(json.dumps(told, ensure_ascii=False))}'"
    return Markup(
        f'<svg class="chart" style="--wide:{width:.0f}" viewBox="0 0 {width:.0f} {height:.0f}" role="img" '
        f'aria-label="{escape(label)}"{data}>'
        f"{content}</svg>"
    )
