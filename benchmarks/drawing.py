"""Charts of the documentation as SVG, which a page of text shows without a script; the report has Plotly."""

import math
from collections.abc import Sequence
from html import escape

import numpy as np
from jaxtyping import Float

from madoc.report.words import number

LEFT, RIGHT, TOP, BOTTOM = 46, 8, 8, 34
"""Margins of a chart of lines."""


def line_chart(
    x: Float[np.ndarray, " points"],
    lines: Sequence[tuple[str, Float[np.ndarray, " points"]]],
    *,
    x_title: str,
    width: int,
    height: int,
) -> str:
    """Lines over a shared axis, each with its class in the style sheet, the last on top."""
    every = np.concatenate([y for _, y in lines])
    air = 0.06 * np.ptp(every)
    low, high, right, base = every.min() - air, every.max() + air, width - RIGHT, height - BOTTOM
    across, up = (right - LEFT) / (x[-1] - x[0]), (base - TOP) / (high - low)
    parts = []
    for mark in ticks(low, high, 4):
        y = base - up * (mark - low)
        parts.append(f'<path class="grid" d="M{LEFT} {y:.1f}H{right}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{number(mark, 3)}</text>')
    for mark in ticks(x[0], x[-1], 5):
        at, anchor = LEFT + across * (mark - x[0]), "end" if mark == x[-1] else "middle"
        parts.append(f'<text x="{at:.1f}" y="{base + 15}" text-anchor="{anchor}">{number(mark)}</text>')
    parts.append(f'<text x="{(LEFT + right) / 2}" y="{height - 4}" text-anchor="middle">{escape(x_title)}</text>')
    for name, y in lines:
        points = zip(LEFT + across * (x - x[0]), base - up * (y - low), strict=True)
        parts.append(f'<path class="{name}" d="M{"L".join(f"{at:.1f} {down:.1f}" for at, down in points)}"/>')
    return "".join(parts)


def scatter_chart(
    points: Float[np.ndarray, "points 2"],
    names: Sequence[str],
    colours: Sequence[str],
    *,
    titles: tuple[str, str],
    width: int,
    height: int,
) -> str:
    """Named points; a thread leads from each to the mean of the points of its colour."""
    spans = np.ptp(points, axis=0)
    margin = np.maximum(0.14 * spans, 0.05 * spans.max())
    low, high = points.min(0) - margin, points.max(0) + margin
    at = (points - low) / (high - low) * (width - 48, 44 - height) + (24, height - 30)
    parts = [f'<rect class="frame" x="24" y="14" width="{width - 48}" height="{height - 44}" rx="6"/>']
    for colour in dict.fromkeys(colours):
        own = at[[index for index, each in enumerate(colours) if each == colour]]
        (x, y) = own.mean(0)
        parts += [f'<path class="thread {colour}" d="M{x:.1f} {y:.1f}L{end[0]:.1f} {end[1]:.1f}"/>' for end in own]
    boxes: list[Box] = [(x - 8, y - 8, x + 8, y + 8) for x, y in at.tolist()]
    for (x, y), name, colour in zip(at.tolist(), names, colours, strict=True):
        left, down = _free_place(x, y, 7.0 * len(name), boxes, (width, height))
        boxes.append(name_box(left, down, 7.0 * len(name)))
        parts.append(f'<circle class="dot {colour}" cx="{x:.1f}" cy="{y:.1f}" r="6.5"/>')
        parts.append(f'<text x="{left:.1f}" y="{down:.1f}">{escape(name)}</text>')
    parts.append(f'<text class="axis" x="{width / 2}" y="{height - 8}" text-anchor="middle">{titles[0]}</text>')
    turned = f'transform="translate(13 {height / 2}) rotate(-90)"'
    return "".join([*parts, f'<text class="axis" {turned} text-anchor="middle">{titles[1]}</text>'])


def ticks(low: float, high: float, wanted: int) -> list[float]:
    """About `wanted` round numbers in [low, high]: multiples of 1, 2 or 5 times a power of ten."""
    if not high > low:
        return [low]
    step = (high - low) / wanted
    size = 10.0 ** math.floor(math.log10(step))
    step = next(size * factor for factor in (1, 2, 5, 10) if size * factor >= step * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [round(step * index, 12) + 0.0 for index in range(first, math.floor(high / step + 1e-9) + 1)]


_PLACES = ((1, 12, 4), (-1, 12, 4), (0, 0, -13), (0, 0, 22), *((side, 10, dy) for side in (1, -1) for dy in (-10, 18)))
_PLACES += tuple((side, 12, dy) for side in (1, -1) for dy in (-26, 34))
"""Places of a name beside its point, the best first: the side (1 right, 0 centred), and offsets across and down."""
Box = tuple[float, float, float, float]


def _free_place(
    x: float, y: float, width: float, taken: Sequence[Box], size: tuple[float, float]
) -> tuple[float, float]:
    """Where a name of that width goes beside its point: the first place that overlaps nothing, else the least bad."""

    def overlap(place: tuple[float, float]) -> float:
        box = name_box(*place, width)
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


def name_box(left: float, base: float, width: float) -> Box:
    return left, base - 13, left + width, base + 3
