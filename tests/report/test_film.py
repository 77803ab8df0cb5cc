"""Films as the page plays them."""

import base64
import json
import re
from html import unescape

import numpy as np

from madoc.report import write_report
from madoc.report.reading import Evidence
from madoc.report.sections.outcome import farthest_apart, read_film


def test_a_film_is_read_with_a_sheet_for_each_panel(whole):
    film = read_film(whole / "film.npz")
    assert (film.size, film.columns, film.rows) == ((4, 2), 2, 2)
    assert {name: base64.b64decode(sheet) for name, sheet in film.sheets.items()} == {
        "calibrated": b"WebP\0",
        "truth": b"WebP\1",
    }
    assert read_film(whole / "elsewhere.npz") is None


def test_a_page_has_a_player_for_each_film(whole):
    text = write_report(whole).read_text()
    told = [json.loads(unescape(each)) for each in re.findall('data-film="(.*?)"', text)]
    assert told == [{"time": [0.0, 0.5, 1.0], "columns": 2, "still": 0}] * 2
    assert text.count('class="sheet"') == 4 and "truth, a yardstick</figcaption>" in text
    assert text.count("aspect-ratio:4/2;background-size:200% 200%") == 4


def test_until_it_is_played_a_film_shows_where_the_model_as_given_errs_most():
    """By hand: a signal whose typical change is 10 counts less, though it errs by more rad."""
    measured = np.zeros((1, 5, 2))
    before = np.array([[[0.0, 0.0], [1.0, 0.0], [0.0, 3.0], [0.5, 0.0], [np.nan, np.nan]]])
    told = Evidence(
        ("a", "b"), ("run",), 0, np.array([1.0, 10.0]), np.arange(5) * 0.5, measured, before, None, None, None
    )
    assert farthest_apart(told, 0, np.array([0.0, 0.5, 1.0, 2.0])) == 1
    assert farthest_apart(told, 0, np.array([0.0, 1.0, 1.5])) == 2
    assert farthest_apart(told, 0, np.array([0.0, 2.0])) == 0
