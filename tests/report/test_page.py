"""Pages of runs: what they say, and that a browser shows them without a word to the network or of complaint."""

import json
import re
import sys
from html import unescape

import pytest
from browser import CHROMIUM, chromium
from run_folders import PARAMETERS, bare_folder, spec, write_json

from madoc.errors import MadocError
from madoc.report import write_comparison, write_report
from madoc.report.page import headline, run_context
from madoc.report.reading import read_run
from madoc.report.sections import SECTIONS
from madoc.report.words import TO_DO, TONES
from madoc.runs.machine import write_peak

IDS = list(SECTIONS)


def content(run, name):
    """What the template of a section of a run's page shows."""
    return SECTIONS[name][1](read_run(run))


def drawn(run, name):
    """The HTML of a section."""
    return re.search(f'<section id="{name}">.*?</section>', write_report(run).read_text(), re.DOTALL).group()


def test_a_page_has_every_section_of_a_whole_run(whole):
    text = write_report(whole).read_text()
    assert [id for id in IDS if f'<section id="{id}">' not in text] == []
    assert "Not in this run" not in text
    assert "The data carries &lt;noise&gt; &amp; more." in text


def test_a_page_says_what_a_bare_run_lacks(bare):
    text = write_report(bare).read_text()
    present = [id for id in IDS if f'<section id="{id}">' in text]
    assert present == ["estimates", "cost", "asked"]
    assert [id for id in IDS if f'<div id="{id}">' not in text and id not in present] == []
    assert "NO VERDICT" in text and "Nothing was held out" in text


def test_an_estimate_stands_where_it_belongs_in_its_range(whole):
    (row,) = [
        row for row in drawn(whole, "estimates").split('<div class="estimate ') if "<b>body_mass.torso</b>" in row
    ]
    # 3.4 ± 0.1 of 3 to 5, the truth at 3.53
    assert 'class="mark" style="left:20.0%"' in row
    assert 'class="span" style="left:15.0%;width:10.0%"' in row
    assert 'class="true" style="left:26.5%"' in row
    assert "<b>3.4</b> kg<small>3.3 to 3.5</small>" in row
    assert "off by 6.5 %" in row


def test_residuals_are_shares_of_a_steps_change(whole):
    # height: ±1 of 2, then 0.1 of 2; speed: ±2 of 4, then 0; the row that failed does not count
    height, speed = content(whole, "residuals")["rows"]
    assert height == ("height", pytest.approx(0.5), pytest.approx(0.05), "10 times less")
    assert speed == ("speed", pytest.approx(0.5), 0.0, "over 10 000 times less")
    assert "50 % → <b>5 %</b>" in drawn(whole, "residuals")


def test_the_error_that_costs_most_is_at_the_top(whole):
    rows = content(whole, "robustness")["costs"]["calibrated"]
    assert [row.largest for _, row in rows] == [6.0, 4.0, 2.0, 1.0]
    told = drawn(whole, "robustness")
    assert '<td>calibrated</td><td class="n">890</td><td class="n">850</td><td class="n">700</td>' in told
    assert 'class="before" style="width:16.67%"></i><i class="after" style="width:100.0%"' in told


def test_the_strongest_correlation_is_told(whole):
    assert content(whole, "correlations")["strongest"] == ["body_mass.leg and body_mass.torso: −0.9"]


def test_missing_terms_are_drawn_by_how_far_they_move_the_estimates(whole):
    friction, spring = content(whole, "lacks")["rows"]
    assert (friction["width"], friction["certain"], friction["moves"]) == (100.0, True, "gravity by −0.4 m/s²")
    assert (spring["width"], spring["certain"], spring["value"]) == (25.0, False, "1 ± 0.4 N·m/rad")
    assert content(whole, "lacks")["alternatives"] == [("a spring (jnt_stiffness.hip)", "gravity 0.1 ± 0.08")]
    assert "0.2 ± 0.02 N·m, <b>t = 10</b>" in drawn(whole, "lacks")


def test_combinations_are_told_with_their_intervals(whole):
    assert "<td>mass·length</td><td>0.5 kg·m</td><td>0.49 to 0.51</td>" in drawn(whole, "together")


def test_a_hold_out_is_told_by_its_own_measure(whole):
    held = content(whole, "holdout")
    assert len(held["facts"]) == 2
    assert [name for _, name in held["legend"]][-1] == "estimate: 0.1"
    file = whole / "calibration" / "result.json"
    stored = json.loads(file.read_text())
    common = {name: value for name, value in stored["holdout"].items() if name != "errors"}
    errors = {"errors": stored["holdout"]["errors"]}
    areas = {
        "area_at_mid_range": {"area": 0.9, "interval": [0.8, 0.95], "rows": 100},
        "area_at_estimate": {"area": 0.52, "interval": [0.45, 0.6], "rows": 100},
    }
    hidden = common | errors | {"measure": "fitted"}
    write_json(file, stored | {"holdout": hidden})
    held = content(whole, "holdout")
    assert len(held["facts"]) == 2 and "control steps ahead of a fitted start" in held["chart"]
    write_json(file, stored | {"holdout": common | areas | {"measure": "told apart"}})
    apart = content(whole, "holdout")
    (area,) = (value for title, value in apart["facts"] if "how well a classifier tells" in title)
    assert area == "0.9 → 0.52"
    assert apart["chart"] is None
    assert run_context(read_run(whole))["facts"][0][0] == "classifier, simulated or logged"


def test_memory_is_told_where_it_is_known(whole):
    assert ("most memory held", "not known") in content(whole, "cost")["facts"]
    write_peak(whole / "calibration", 512_000_000)
    assert ("most memory held", "512 MB") in content(whole, "cost")["facts"]


def test_time_is_told_by_stage(whole):
    stages = content(whole, "cost")["stages"]
    assert [(stage["name"], stage["share"], stage["words"]) for stage in stages] == [
        ("cloning", pytest.approx(2 / 32), "2.0 s, 0 control steps"),
        ("calibrating", pytest.approx(30 / 32), "30 s, 3 000 control steps"),
    ]


@pytest.mark.parametrize(
    ("change", "word", "tone"),
    [
        ({"verdict": {"word": "MODEL_MISMATCH", "sentence": "s"}}, "MODEL MISMATCH", "bad"),
        ({"verdict": {"word": "NO_IMPROVEMENT", "sentence": "s"}}, "NO IMPROVEMENT", "doubtful"),
        ({}, "NO VERDICT", "neutral"),
        ({"status": "diverged"}, "DIVERGED", "bad"),
        ({"status": "interrupted"}, "INTERRUPTED", "doubtful"),
    ],
)
def test_the_word_on_top_is_the_verdicts_or_how_it_ended(tmp_path, change, word, tone):
    top = headline(read_run(bare_folder(tmp_path / "run", **change)))
    assert (top.word, top.tone) == (word, tone) and bool(top.to_do) == ("verdict" in change)


@pytest.mark.parametrize("word", TONES)
def test_every_verdict_says_on_top_of_its_page_what_to_do(tmp_path, word):
    folder = bare_folder(tmp_path / "run", verdict={"word": word, "sentence": "s"})
    assert f"<b>What to do:</b> {TO_DO[word].split(',')[0]}" in unescape(write_report(folder).read_text())


def test_a_run_that_has_not_ended_says_so(whole):
    (whole / "calibration" / "result.json").unlink()
    text = write_report(whole).read_text()
    assert "NOT ENDED" in text and "The run has not ended." in text and '<section id="trace">' in text


def test_a_page_is_written_again_but_nothing_else_is_written_over(bare, tmp_path):
    assert write_report(bare) == write_report(bare) == bare / "report.html"
    with pytest.raises(MadocError, match=r"result.json exists and is no page of madoc report"):
        write_report(bare, bare / "result.json")
    with pytest.raises(MadocError, match="is a folder; name a file"):
        write_report(bare, tmp_path)


def test_nothing_from_a_folder_becomes_markup(tmp_path):
    evil = "<img src=x onerror=alert(1)>"
    folder = bare_folder(tmp_path / "run", sentence=evil, warnings=[evil], method=evil)
    write_json(folder / "spec.json", spec(task=evil, versions={evil: evil}))
    assert evil not in write_report(folder).read_text()


def test_a_page_asks_for_nothing_outside_of_itself(whole):
    text = re.sub(r"[A-Za-z0-9+/=]{500,}", "packed", write_report(whole).read_text())  # Plotly; a browser looks into it
    assert re.findall(r"(?:https?:)?//[a-z0-9]", text) == []
    asked = re.findall(r"<link[^>]*>|<script[^>]+>|url\((?!data:)[^)]*\)|@import", text)
    assert asked == ['<link rel="icon" href="data:,">', '<script type="text/plain" id="plotly">']


def test_a_page_without_charts_has_no_library_of_them(whole, bare):
    assert write_report(bare).stat().st_size < 100_000 < 2_000_000 < write_report(whole).stat().st_size < 5_000_000


def test_signals_are_drawn_in_whole_runs_with_residuals(whole):
    shown = content(whole, "signals")
    assert shown["names"] == ("first.csv", "<second>.csv") and shown["every"] == 1
    figure = json.loads(unescape(re.search('data-figure="(.*?)"', shown["charts"][0]["chart"]).group(1)))
    lines = [line for line in figure["data"] if line["meta"] == 1]
    assert [line["y"] for line in lines] == [
        [6.0, 8.0, None],  # measured, up to its end
        [7.0, 9.0, None],
        [6.1, 8.1, None],
        [1.0, 1.0, None],  # less what was measured
        [0.1, 0.1, None],
    ]
    assert [line["visible"] for line in figure["data"]] == [True] * 5 + [False] * 5
    # 0 to 4 measured, and 5 in the model as given, with 6 % of air; residuals of 0.1, and of 1 cut at 0.1 + 2 % of 4
    low, high = figure["layout"]["meta"]["yaxis"][0]
    assert (low, high) == (pytest.approx(-0.3), pytest.approx(5.3))
    assert figure["layout"]["meta"]["yaxis2"][0] == pytest.approx([0.1 - 0.0048, 0.18 + 0.0048])
    assert "<option>&lt;second&gt;.csv</option>" in drawn(whole, "signals")


def test_of_long_runs_every_so_many_rows_are_drawn(whole, monkeypatch):
    monkeypatch.setattr(sys.modules["madoc.report.sections.holdout"], "NUMBERS", 40)  # a function has its name
    shown = content(whole, "signals")
    assert shown["every"] == 2  # 2 runs, 3 times, 2 signals and 5 lines of them: 60 values
    assert '"dx":0.02' in unescape(shown["charts"][0]["chart"]) and "One row of 2 is drawn." in drawn(whole, "signals")


def test_a_comparison_puts_estimates_side_by_side(whole, bare):
    page = write_comparison([whole, bare], whole.parent / "both.html")
    text = page.read_text()
    assert text.count('class="lane-name">whole') == text.count('class="lane-name">bare') == len(PARAMETERS)
    assert "CALIBRATED" in text and "NO VERDICT" in text


def test_runs_of_one_name_are_told_apart(tmp_path):
    runs = [bare_folder(tmp_path / parent / "run") for parent in ("first", "second")]
    text = write_comparison(runs, tmp_path / "both.html").read_text()
    assert "first/run" in text and "second/run" in text


def test_runs_on_different_data_are_said_to_be(tmp_path):
    runs = [bare_folder(tmp_path / name) for name in ("one", "other")]
    write_json(runs[1] / "spec.json", spec(data={"rows": 1, "fingerprint": "00000000"}))
    assert "calibrated to different data" in write_comparison(runs, tmp_path / "both.html").read_text()


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here; Debian's package chromium has it")
def test_a_browser_shows_pages_without_complaint_or_network(whole, bare, tmp_path):
    pages = {
        write_report(whole): ["verdict", "warnings", *IDS],
        write_report(bare): ["verdict", "warnings", *IDS],
        write_comparison([whole, bare], tmp_path / "both.html"): ["runs", "estimates", "errors", "costs", "doubts"],
    }
    with chromium() as page:
        for file, ids in pages.items():
            for width, scheme in ((1200, "light"), (390, "dark")):
                page.open(file, width=width, scheme=scheme)
                shown = (
                    "(id => (e => e !== null && e.getBoundingClientRect().height > 15)(document.getElementById(id)))"
                )
                assert page.ask_script(f"{ids!r}.filter(id => !{shown}(id))") == []
                assert page.ask_script("document.documentElement.scrollWidth") <= width, "wider than the window"
                page.ask_script("document.querySelector('[data-figure]')?.scrollIntoView()")  # drawn when it comes near
                page.wait_for("document.querySelector('[data-figure]') === null || document.querySelector('svg text')")
                heights = "[...document.querySelectorAll('svg text')].map(e => e.getBoundingClientRect().height)"
                small = f"{heights}.filter(height => 0 < height && height < 9)"
                assert page.ask_script(f"{small}.length") == 0, "words too small to read"
        page.open(write_report(whole))
        page.ask_script("document.documentElement.style.scrollBehavior = 'auto'; signals.scrollIntoView()")
        page.wait_for("document.querySelector('#signals .nsewdrag')")
        point = "(box => [box.x + box.width / 2, box.y + box.height / 2])"
        page.move_pointer(
            *page.ask_script(f"{point}(document.querySelector('#signals .nsewdrag').getBoundingClientRect())")
        )
        page.wait_for("document.querySelector('#signals .hoverlayer').textContent.includes('calibrated')")
        page.ask_script(
            "(box => (box.selectedIndex = 1, box.dispatchEvent(new Event('change'))))(signals.querySelector('select'))"
        )
        shown = "signals.querySelector('[data-figure]').data.filter(line => line.visible).map(line => line.meta)"
        assert page.ask_script(shown) == [1] * 5
        place = "motion.querySelector('.sheet').style.backgroundPosition"
        assert page.ask_script(place) == "0% 0%"
        page.ask_script("motion.querySelector('button').click()")
        page.wait_for("motion.querySelector('output').textContent === '1.00 s'")
        assert page.ask_script(place) == "0% 100%"  # the third of three pictures, two in a row
        asked = {request for request in page.requests if not re.match("data:image/(webp|png);", request)}
        assert asked == {file.resolve().as_uri() for file in pages}
        assert page.complaints == []
