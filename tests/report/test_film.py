"""Films as the page plays them."""

import base64
import json
import re
from html import unescape

from madoc.report import write_report
from madoc.report.sections.robustness import read_film


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
    assert told == [{"time": [0.0, 0.5, 1.0], "columns": 2}] * 2
    assert text.count('class="sheet"') == 4 and "truth, a yardstick</figcaption>" in text
    assert text.count("aspect-ratio:4/2;background-size:200% 200%") == 4
