"""The page of a run: one HTML file with all it needs inside, and no script needed to read it."""

import datetime
import functools
from dataclasses import dataclass, replace
from pathlib import Path

import jinja2

from madoc.calibration.holdout import HoldOut, ToldApart
from madoc.errors import MadocError
from madoc.report import sections
from madoc.report.reading import Run, read_run
from madoc.report.sections import Shown
from madoc.report.words import count, duration, number
from madoc.runs.files import replacing

GENERATOR = "madoc report"
"""What a page says it was made by; only such files are written over."""


def write_report(run: Path, out: Path | None = None) -> Path:
    """Write the page of one run.

    Args:
        run: A folder of `madoc calibrate` or `madoc run`, ended or not.
        out: The page; None takes `report.html` in the folder.

    Returns:
        Where it is.

    Raises:
        MadocError: There is no run, a file of it is damaged, or the page cannot be written.
    """
    read = read_run(run)
    page = out.expanduser() if out is not None else read.whole / "report.html"
    write_page(page, "run.html", run_context(read))
    return page


def run_context(run: Run) -> Shown:
    """What the template of one run shows."""
    made = [section(run) for section in sections.ALL]
    if not run.parameters:
        made = [replace(each, absent=sections.NOT_ENDED) if each.data is None else each for each in made]
    return {
        "title": f"{run.spec.task} · {run.method}",
        "run": run,
        "verdict": headline(run),
        "facts": _facts(run),
        "sections": made,
        "absent": [section for section in made if section.data is None],
        "ended": _ended(run),
    }


@dataclass(frozen=True)
class Headline:
    """What stands on top of a page.

    Attributes:
        word: The verdict; how the run ended, where it was given none.
        tone: Class that colours it.
        sentence: The reason.
        note: How the run ended.
    """

    word: str
    tone: str
    sentence: str
    note: str


_UNJUDGED = {
    "interrupted": ("doubtful", "The run was interrupted: the estimate is that of the moment."),
    "diverged": ("bad", "The run stopped on a number that is none: do not use the estimate."),
}
"""Tone and sentence of a run without a verdict, by how it ended."""


def headline(run: Run) -> Headline:
    """The verdict, or how the run ended where it was given none."""
    if run.result is None:
        sentence = "The run has not ended: this page shows what it has done so far."
        return Headline((run.status or "NOT ENDED").upper(), "doubtful", sentence, run.sentence)
    if run.result.verdict is not None:
        verdict = run.result.verdict
        return Headline(verdict.word.replace("_", " "), sections.TONES[verdict.word], verdict.sentence, run.sentence)
    if run.result.status in _UNJUDGED:
        return Headline(run.result.status.upper(), *_UNJUDGED[run.result.status], run.sentence)
    sentence = "Nothing was held out, so this estimate was not tried on data it has not seen."
    return Headline("NO VERDICT", "neutral", sentence, run.sentence)


@dataclass(frozen=True)
class Fact:
    """A number worth the top of the page."""

    title: str
    value: str
    note: str


def _facts(run: Run) -> list[Fact]:
    facts = [_on_holdout(run.holdout)] if run.holdout else []
    if run.error_percent is not None:
        facts.append(Fact("off the truth", f"{number(run.error_percent, 3)} %", "of the range, on average"))
    if run.result is not None:
        facts.append(Fact("control steps", count(run.result.control_steps), "simulated"))
        facts.append(Fact("time", duration(run.result.seconds), "wall clock"))
    if run.spec.data is not None and run.spec.data.rows is not None:
        facts.append(Fact("log", count(run.spec.data.rows), f"rows · {run.spec.data.fingerprint}"))
    return facts


def _on_holdout(held: HoldOut) -> Fact:
    """The hold-out's measure in one number."""
    if isinstance(held, ToldApart):
        low, high = (number(end, 2) for end in held.area_at_estimate.interval)
        note = f"area of a classifier, {low} to {high}; 0.5 is chance"
        return Fact("told from the log", number(held.area_at_estimate.area, 2), note)
    value, low, high = (f"{number(100 * share, 3)} %" for share in (held.score, *held.score_interval))
    return Fact("error on the hold-out", value, f"of mid-range's; {low} to {high}")


def _ended(run: Run) -> str:
    """When the result was written."""
    file = run.folder / "result.json"
    if not file.exists():
        return ""
    return datetime.datetime.fromtimestamp(file.stat().st_mtime).strftime("%Y-%m-%d %H:%M")


def write_page(page: Path, template: str, context: Shown) -> None:
    """Render a template into a file, whole or not at all.

    Raises:
        MadocError: There is something else than a page of ours, or it cannot be written.
    """
    if page.is_dir():
        raise MadocError(f"{page} is a folder; name a file for the page, as {page / 'report.html'}")
    if page.exists() and GENERATOR not in page.read_bytes()[:2000].decode("utf-8", "replace"):
        raise MadocError(f"{page} exists and is no page of madoc report; choose another --out")
    text = render(template, context)
    with replacing(page) as stream:
        stream.write(text.encode())


def render(template: str, context: Shown) -> str:
    """A template's text; every word from a file is escaped."""
    return _environment().get_template(template).render(context | {"generator": GENERATOR})


@functools.cache
def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.PackageLoader("madoc.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
