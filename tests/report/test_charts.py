"""Charts as Plotly takes them, and checked by Plotly's own classes."""

import json
import re
from html import unescape

import numpy as np
import plotly.graph_objects
import pytest

from madoc.report.charts import Level, Line, line_chart, matrix_chart, scatter_chart, thinned


def told(chart):
    """The figure that the page's script is given, which Plotly accepts once colours have their values."""
    text = unescape(re.search(r'data-figure="(.*?)"', str(chart)).group(1))
    plotly.graph_objects.Figure(json.loads(re.sub(r"var\(--[a-z0-9]+\)", "#1f6fd6", text)))
    return json.loads(text)


def test_a_missing_value_breaks_the_line():
    chart = line_chart(np.arange(4.0), [Line("a", np.array([1.0, np.nan, 2.0, 3.0]), "g0")], label="gap", x_title="t")
    (line,) = told(chart)["data"]
    assert (line["x"], line["y"], line["name"]) == ([0.0, 1.0, 2.0, 3.0], [1.0, None, 2.0, 3.0], "a")
    assert line["line"]["color"] == "var(--g0)"


def test_a_band_is_filled_between_its_ends_below_the_line():
    ends = np.array([0.0, 1.0]), np.array([2.0, 3.0])
    low, high, line = told(
        line_chart(np.arange(2.0), [Line("a", np.ones(2), "after", *ends)], label="band", x_title="t")
    )["data"]
    assert (low["y"], high["y"], line["y"]) == ([0.0, 1.0], [2.0, 3.0], [1.0, 1.0])
    assert (high["fill"], high["fillcolor"]) == ("tonexty", "var(--after)2b")


def test_levels_go_from_end_to_end_and_axes_are_what_is_asked():
    line = Line("a", np.array([0.0, 1.0]), "g0")
    figure = told(
        line_chart(
            np.arange(2.0), [line], label="l", x_title="t", y_range=(0.1, 1.0), levels=[Level(0.5, "chance")], log=True
        )
    )
    assert (figure["data"][1]["x"], figure["data"][1]["y"]) == ([0.0, 1.0], [0.5, 0.5])
    assert figure["layout"]["yaxis"]["type"] == "log"
    assert figure["layout"]["yaxis"]["range"] == pytest.approx([-1.0, 0.0])  # of a logarithmic axis they are powers


def test_names_are_escaped_for_the_page_and_for_plotly():
    line = Line("<script>'\"", np.array([0.0, 1.0]), "g0")
    chart = line_chart(np.arange(2.0), [line], label='a "quote" <b>', x_title="<t>")
    assert "<" not in str(chart)[1:].replace("</div>", "")
    assert unescape(told(chart)["data"][0]["name"]) == "<script>'\""
    assert 'aria-label="a &#34;quote&#34; &lt;b&gt;"' in str(chart)


def test_names_of_near_points_stand_on_other_sides():
    points = np.array([[0.0, 0.0], [0.0, 0.1], [5.0, 5.0]])
    (dots,) = told(scatter_chart(points, ["low", "high", "far"], ["g0"] * 3, label="p", titles=("x", "y")))["data"]
    assert dots["textposition"] == ["bottom center", "top center", "top center"]


def test_a_matrix_shows_each_pair_once():
    values = np.array([[1.0, 0.5, -0.9], [0.5, 1.0, 0.0], [-0.9, 0.0, 1.0]])
    (cells,) = told(matrix_chart(values, ["a", "b", "c"], label="m"))["data"]
    assert (cells["x"], cells["y"]) == (["a", "b"], ["b", "c"])
    assert cells["z"] == [[0.5, None], [-0.9, 0.0]]
    assert cells["text"] == [["0.50", ""], ["−0.90", "0.00"]]


def test_many_values_are_thinned_to_means_between_extremes():
    x, y, low, high = thinned(np.arange(6.0), np.array([1.0, 3.0, np.nan, 5.0, np.nan, np.nan]), points=3)
    assert (x.tolist(), y[:2].tolist(), low[:2].tolist(), high[:2].tolist()) == (
        [0.5, 2.5, 4.5],
        [2.0, 5.0],
        [1.0, 5.0],
        [3.0, 5.0],
    )
    assert np.isnan([y[2], low[2], high[2]]).all()


def test_few_values_stay_as_they_are():
    values = np.array([1.0, 2.0])
    x, y, low, high = thinned(values, values, points=3)
    assert x is values and y is values and low is None and high is None
