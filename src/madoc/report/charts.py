"""Charts as figures of Plotly, which the page's script draws: a reader zooms, and reads values under the pointer.

A figure is the JSON that Plotly takes, made by hand, as its Python classes take a second to import. Colours are names
of the style sheet, as `var(--after)`, so that a chart follows the page's colour scheme; the script puts values in.
"""

import json
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from markupsafe import Markup, escape

HEIGHT = 230
"""Height of a chart of lines in pixels."""
POINTS = 240
"""Largest number of points of a line of metrics; a longer line is thinned."""
BAND = "2b"
"""Opacity of a band, a sixth, as the last two digits of a colour."""

Figure = Mapping[str, object]
"""`data` and `layout`, as Plotly takes them."""


@dataclass(frozen=True)
class Line:
    """One line of a chart, in a colour of the style sheet; NaN breaks it, `low` and `high` are the ends of a band."""

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
    y_range: tuple[float, float] | None = None,
    levels: Sequence[Level] = (),
    log: bool = False,
) -> Markup:
    """Lines over a shared, ascending axis, the last on top; the label says what they show to those who cannot see it.

    Without `y_range`, the vertical axis fits what is drawn. With `log` it is in powers of ten, and values that are not
    positive are left out.
    """
    data = [trace for line in lines for trace in _traces(x, line)]
    for level in levels:
        ends = [float(x[0]), float(x[-1])]
        dots = {"color": _colour(level.colour), "width": 1.5, "dash": "dash"}
        data.append({"x": ends, "y": [level.value] * 2, "name": level.name, "mode": "lines", "line": dots})
    y_axis: dict[str, object] = {"type": "log"} if log else {}
    if y_range is not None:
        y_axis["range"] = np.log10(y_range).tolist() if log else y_range  # Plotly asks for powers
    axes = {"xaxis": {"title": {"text": _text(x_title)}}, "yaxis": y_axis}
    return drawn({"data": data, "layout": {"height": HEIGHT, "hovermode": "x unified"} | axes}, label)


def _traces(x: Float[np.ndarray, " points"], line: Line) -> list[Figure]:
    """A line, before it the two ends of its band."""
    colour = _colour(line.colour)
    band: list[Figure] = []
    if line.low is not None and line.high is not None:
        bare = {"x": rounded(x), "mode": "lines", "line": {"width": 0}, "hoverinfo": "skip"}
        band = [bare | {"y": rounded(line.low)}]
        band += [bare | {"y": rounded(line.high), "fill": "tonexty", "fillcolor": f"{colour}{BAND}"}]
    pen = {"color": colour, "width": 2, "dash": "dash" if line.dashed else "solid"}
    return [*band, {"x": rounded(x), "y": rounded(line.y), "name": _text(line.name), "mode": "lines", "line": pen}]


def scatter_chart(
    points: Float[np.ndarray, "points 2"],
    names: Sequence[str],
    colours: Sequence[str],
    *,
    label: str,
    titles: tuple[str, str],
) -> Markup:
    """Named points; each name stands on the side that the nearest other point is not on."""
    far = np.linalg.norm(points[:, None] - points, axis=-1) + np.diag(np.full(len(points), np.inf))
    above = points[:, 1] >= points[far.argmin(1), 1]
    trace = {
        "x": rounded(points[:, 0]),
        "y": rounded(points[:, 1]),
        "text": [_text(name) for name in names],
        "mode": "markers+text",
        "textposition": ["top center" if up else "bottom center" for up in above.tolist()],
        "cliponaxis": False,
        "marker": {"size": 13, "color": [_colour(colour) for colour in colours]},
        "hoverinfo": "text",
    }
    axes = {f"{axis}axis": {"title": {"text": title}} for axis, title in zip("xy", titles, strict=True)}
    return drawn({"data": [trace], "layout": {"height": 420, "hovermode": "closest"} | axes}, label)


def matrix_chart(values: Float[np.ndarray, "d d"], names: Sequence[str], *, label: str) -> Markup:
    """The lower half of a symmetric matrix in [-1, 1], without its diagonal."""
    half = np.where(np.tri(len(names), k=-1, dtype=bool), values, np.nan)[1:, :-1]
    titles = [_text(name) for name in names]
    cells = [[f"{value:.2f}".replace("-", "−") if math.isfinite(value) else "" for value in row] for row in half]
    trace = {
        "type": "heatmap",
        "z": [rounded(row) for row in half],
        "x": titles[:-1],
        "y": titles[1:],
        "zmin": -1.0,
        "zmax": 1.0,
        "colorscale": [[0.0, _colour("g1")], [0.5, "var(--card)"], [1.0, _colour("g0")]],
        "showscale": False,
        "xgap": 2,
        "ygap": 2,
        "hovertemplate": "%{y} and %{x}: %{z}<extra></extra>",
    }
    if len(names) <= 12:
        trace |= {"text": cells, "texttemplate": "%{text}"}
    layout = {"height": 110 + 34 * len(names), "yaxis": {"autorange": "reversed"}, "hovermode": "closest"}
    return drawn({"data": [trace], "layout": layout}, label)


def drawn(figure: Figure, label: str) -> Markup:
    """The place on the page where the script draws a figure."""
    content = json.dumps(figure, ensure_ascii=False, separators=(",", ":"))
    layout = figure["layout"]
    assert isinstance(layout, Mapping)
    return Markup('<div class="chart" role="img" aria-label="{}" style="height:{}px" data-figure="{}"></div>').format(
        label, layout["height"], content
    )


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


def _colour(name: str) -> str:
    return f"var(--{name})"


def _text(words: str) -> str:
    """Words that Plotly, which knows some tags, shows as they are."""
    return str(escape(words))


def rounded(values: Float[np.ndarray, " values"]) -> list[float | None]:
    """Values with five digits, None where there is none."""
    return [float(f"{value:.5g}") if math.isfinite(value) else None for value in values.tolist()]
