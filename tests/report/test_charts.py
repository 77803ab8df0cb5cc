"""Charts: where things are drawn, worked out by hand."""

import json
import re
from html import unescape
from xml.etree import ElementTree

import numpy as np
import pytest

from madoc.report.charts import Level, Line, line_chart, matrix_chart, scatter_chart, thinned, ticks


def drawn(chart):
    """The chart as XML."""
    return ElementTree.fromstring(str(chart))


def told(chart):
    """What the page's script is told."""
    return json.loads(unescape(re.search(r'data-values="(.*?)"', str(chart)).group(1)))


@pytest.mark.parametrize(
    ("low", "high", "wanted", "found"),
    [
        (0.0, 1.0, 4, [0.0, 0.5, 1.0]),
        (-30.0, 0.0, 4, [-30.0, -20.0, -10.0, 0.0]),
        (3.0, 5.0, 4, [3.0, 3.5, 4.0, 4.5, 5.0]),
        (0.0, 60000.0, 5, [0.0, 20000.0, 40000.0, 60000.0]),
        (0.02, 0.11, 3, [0.05, 0.1]),
        (2.0, 2.0, 4, [2.0]),
    ],
)
def test_ticks_are_round_numbers_inside(low, high, wanted, found):
    assert ticks(low, high, wanted) == pytest.approx(found)


def test_a_line_goes_from_corner_to_corner():
    chart = line_chart(
        np.array([0.0, 1.0]), [Line("a", np.array([0.0, 2.0]), "g0")], label="up", x_title="t", y_range=(0.0, 2.0)
    )
    # 340 wide, 46 left and 8 right of the axes; 190 high, 8 above and 34 below
    assert drawn(chart).find("svg/path").attrib["d"] == "M46.0 156.0L332.0 8.0"


def test_powers_of_ten_stand_equally_far_apart():
    values = np.array([1.0, 10.0, 100.0])
    chart = line_chart(
        np.arange(3.0), [Line("a", values, "g0")], label="log", x_title="t", y_range=(1.0, 100.0), log=True
    )
    heights = [float(point.split()[1]) for point in re.split("[ML]", drawn(chart).find("svg/path").attrib["d"])[1:]]
    assert heights == pytest.approx([156.0, 82.0, 8.0], abs=0.05)


def test_a_missing_value_breaks_the_line_and_is_told_as_none():
    chart = line_chart(np.arange(4.0), [Line("a", np.array([1.0, np.nan, 2.0, 3.0]), "g0")], label="gap", x_title="t")
    assert drawn(chart).find("svg/path").attrib["d"].count("M") == 2
    assert told(chart)["lines"] == [["a", "g0", [1.0, None, 2.0, 3.0]]]


def test_a_level_outside_of_the_axis_is_left_out():
    line = Line("a", np.array([0.0, 1.0]), "g0")
    levels = [Level(0.5, "inside"), Level(7.0, "outside")]
    chart = line_chart(np.arange(2.0), [line], label="l", x_title="t", y_range=(0.0, 1.0), levels=levels)
    assert [each.attrib["y1"] for each in drawn(chart).findall("svg/line") if "level" in each.attrib["class"]] == [
        "82.0"
    ]


def test_names_are_escaped():
    line = Line("<script>'\"", np.array([0.0, 1.0]), "g0")
    chart = line_chart(np.arange(2.0), [line], label='a "quote" <b>', x_title="<t>")
    assert "<script>" not in str(chart) and told(chart)["lines"][0][0] == "<script>'\""
    assert drawn(chart).attrib["aria-label"] == 'a "quote" <b>'


def test_labels_of_points_do_not_lie_on_each_other():
    points = np.array([[0.0, 0.0], [0.05, 0.0], [0.0, 0.05], [1.0, 1.0]])
    chart = drawn(
        scatter_chart(points, ["first one", "second one", "third one", "far"], ["g0"] * 4, label="p", titles=("x", "y"))
    )
    boxes = [
        (float(text.attrib["x"]), float(text.attrib["y"]), 7.0 * len(text.text))
        for text in chart.findall("text")
        if text.attrib["class"] == "name"
    ]
    for index, (left, base, width) in enumerate(boxes):
        for other_left, other_base, other_width in boxes[:index]:
            apart = abs(base - other_base) >= 16 or left + width <= other_left or other_left + other_width <= left
            assert apart


def test_points_that_are_all_the_same_are_drawn():
    chart = drawn(scatter_chart(np.zeros((3, 2)), ["a", "b", "c"], ["g0"] * 3, label="p", titles=("x", "y")))
    assert all(np.isfinite(float(dot.attrib["cx"])) for dot in chart.findall("circle"))


def test_a_matrix_shows_each_pair_once():
    values = np.array([[1.0, 0.5, -0.9], [0.5, 1.0, 0.0], [-0.9, 0.0, 1.0]])
    cells = drawn(matrix_chart(values, ["a", "b", "c"], label="m")).findall("g")
    assert [cell.find("title").text for cell in cells] == ["b and a: 0.5", "c and a: −0.9", "c and b: 0"]
    assert [cell.find("text").text for cell in cells] == ["0.50", "−0.90", "0.00"]
    assert [cell.findall("rect")[1].attrib["style"] for cell in cells] == [
        "opacity:0.500",
        "opacity:0.900",
        "opacity:0.000",
    ]


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
