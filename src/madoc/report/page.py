"""The page of a run, or of several: one HTML file with all it needs inside.

Words and tables need no script, charts and films do.
"""

import base64
import datetime
import functools
import gzip
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import jinja2
from markupsafe import Markup

from madoc.calibration.holdout import HoldOut, ToldApart
from madoc.errors import MadocError, printable
from madoc.report import words
from madoc.report.reading import Run, read_run
from madoc.report.sections import SECTIONS
from madoc.report.words import TONES, count, duration, number, percent, to_do
from madoc.runs.files import replacing

GENERATOR = "madoc report"
"""The generator that a page names in its head; only a file that names it is overwritten."""


@functools.cache
def templates() -> jinja2.Environment:
    """All templates; every word that comes from a file is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("madoc.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_printable,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    names = ("number", "percent", "count", "duration", "spread", "spread_words", "place")
    environment.filters |= {name: getattr(words, name) for name in names}
    environment.filters |= {"unit": words.unit_words, "interval": words.interval_words}
    environment.globals |= {"TONES": words.TONES, "generator": GENERATOR}
    return environment


def _printable(value: object) -> object:
    """A value of a template; text that would turn the direction of what follows is written as numbers."""
    return printable(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def plotly() -> str:
    """Plotly's script as base64 of gzip, which the page's own script unpacks: 2 MB in place of 4.8."""
    script = resources.files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    return base64.b64encode(gzip.compress(script, mtime=0)).decode()


def write_report(run: Path, out: Path | None = None) -> Path:
    """Write the page of one run, ended or not; by default it is `report.html` in the run folder.

    Raises:
        MadocError: There is no run, a file of it is damaged, or the page cannot be written.
    """
    read = read_run(run)
    page = out.expanduser() if out is not None else read.whole / "report.html"
    write_page(page, "run.html", run_context(read))
    return page


def leave_report(folder: Path) -> Path | None:
    """Write `report.html` into a run folder; a failure is a warning only, as the result is written already."""
    try:
        return write_report(folder)
    except Exception as error:
        warnings.warn(f"no report.html was written into {folder}: {error}", stacklevel=2)
        return None


def run_context(run: Run) -> dict[str, object]:
    """What the template of one run shows."""
    present, absent = [], []
    for name, (title, section) in SECTIONS.items():
        content = section(run)
        if isinstance(content, str):
            content = content if run.parameters else "The run has not ended."
            absent.append({"id": name, "title": title, "content": content})
        else:
            present.append({"id": name, "title": title, "content": content})
    return {
        "title": f"{run.spec.task} · {run.method}",
        "run": run,
        "verdict": headline(run),
        "facts": _facts(run),
        "sections": present,
        "absent": absent,
        "ended": _ended(run),
    }


@dataclass(frozen=True)
class Headline:
    """The top of a page: the verdict (or how the run ended), its colour class, the reason, how it ended, what to do."""

    word: str
    tone: str
    sentence: str
    note: str
    to_do: str = ""


_LIBRARY = "PLOTLY IS NOT NEEDED"
"""What stands in the template where the library of charts goes, on pages that have any."""
_UNJUDGED = {
    "interrupted": ("doubtful", "The run was interrupted: the estimate is that of the moment."),
    "diverged": ("bad", "The run stopped as a value became NaN or infinite: do not use the estimate."),
}
"""Colour class and sentence of a run without a verdict, by how it ended."""


def headline(run: Run) -> Headline:
    """The verdict of a run, or how it ended where it has no verdict."""
    if run.result is None:
        sentence = "The run has not ended: this page shows what it has done so far."
        return Headline((run.status or "NOT ENDED").upper(), "doubtful", sentence, run.sentence)
    if run.result.verdict is not None:
        verdict, word = run.result.verdict, run.result.verdict.word
        return Headline(word.replace("_", " "), TONES[word], verdict.sentence, run.sentence, to_do(run.result))
    if run.result.status in _UNJUDGED:
        return Headline(run.result.status.upper(), *_UNJUDGED[run.result.status], run.sentence)
    sentence = "Nothing was held out, so this estimate was not tried on data it has not seen."
    return Headline("NO VERDICT", "neutral", sentence, run.sentence)


def _facts(run: Run) -> list[tuple[str, str, str]]:
    """Numbers for the top of the page: the title, value and note of each."""
    facts = [_on_holdout(run.holdout)] if run.holdout else []
    if run.error_percent is not None:
        facts.append(("off the truth", f"{number(run.error_percent, 3)} %", "of the range, on average"))
    if run.result is not None:
        facts.append(("control steps", count(run.result.control_steps), "simulated"))
        facts.append(("time", duration(run.result.seconds + run.result.judging_seconds), "search and judging"))
    if run.spec.data is not None:
        facts.append(("log", count(run.spec.data.rows), f"rows, checksum {run.spec.data.fingerprint}"))
    return facts


def _on_holdout(held: HoldOut) -> tuple[str, str, str]:
    """The measure of the hold-out in one number."""
    if isinstance(held, ToldApart):
        low, high = (number(end, 2) for end in held.area_at_estimate.interval)
        note = f"area of a classifier, {low} to {high}; 0.5 is chance"
        return "classifier, simulated or logged", number(held.area_at_estimate.area, 2), note
    if held.ahead is not None:
        value, low, high = map(percent, (held.ahead.relative, *held.ahead.relative_interval))
        ahead = f"over {number(held.ahead.seconds, 3)} s, of all signals that show more than noise"
        note = f"of the error of your model as given, {ahead}; 95 % interval {low} to {high}"
        return "error on the hold-out", value, note
    value, low, high = map(percent, (held.score, *held.score_interval))
    return "error on the hold-out", value, f"of that at mid-range, over all times and signals; {low} to {high}"


def _ended(run: Run) -> str:
    """When the result was written."""
    file = run.folder / "result.json"
    if not file.exists():
        return ""
    return datetime.datetime.fromtimestamp(file.stat().st_mtime).strftime("%Y-%m-%d %H:%M")


def _is_ours(page: Path) -> bool:
    """Whether a file is a page of this command; a pipe or device is none."""
    if not page.is_file():
        return False
    with page.open("rb") as file:
        return GENERATOR in file.read(2000).decode("utf-8", "replace")


def write_page(page: Path, template: str, context: dict[str, object]) -> None:
    """Render a template into a file, whole or not at all; every word from a run's files is escaped.

    Raises:
        MadocError: The place is taken by something else than a page of ours, or the file cannot be written.
    """
    if page.is_dir():
        raise MadocError(f"{page} is a folder; name a file for the page, as {page / 'report.html'}")
    if page.exists() and not _is_ours(page):
        raise MadocError(f"{page} exists and is no page of madoc report; choose another --out")
    text = templates().get_template(template).render(context)
    if "data-figure=" in text:
        text = text.replace(_LIBRARY, plotly(), 1)
    with replacing(page) as stream:
        stream.write(text.encode())


def write_comparison(runs: Sequence[Path], out: Path | None = None) -> Path:
    """Write one page on several runs; by default it is `comparison.html` in the working directory.

    Raises:
        MadocError: A run cannot be read, or the page cannot be written.
    """
    if len(runs) < 2:
        raise MadocError(f"expected at least 2 runs to compare, got {len(runs)}")
    page = (out or Path("comparison.html")).expanduser()
    write_page(page, "comparison.html", _compared([read_run(run) for run in runs]))
    return page


def _compared(runs: Sequence[Run]) -> dict[str, object]:
    """What the template of several runs shows."""
    names = dict(zip(_distinct_names(runs), runs, strict=True))
    parameters = dict.fromkeys(name for run in runs for name in run.parameters)
    return {
        "title": f"{len(runs)} runs compared",
        "runs": names,
        "colours": {name: f"g{index % 8}" for index, name in enumerate(names)},
        "headline": headline,
        "notes": _notes(runs),
        "parameters": [_shared_parameter(parameter, names) for parameter in parameters],
        "costs": {name: run.result.seconds for name, run in names.items() if run.result},
        "errors": {name: run.error_percent for name, run in names.items() if run.error_percent is not None},
    }


def _shared_parameter(name: str, runs: Mapping[str, Run]) -> dict[str, object]:
    """A parameter, with an axis that holds the ranges of all runs."""
    rows = [run.parameters[name] for run in runs.values() if name in run.parameters]
    truth = next((run.truth[name] for run in runs.values() if name in run.truth), None)
    low, high = min(row.low for row in rows), max(row.high for row in rows)
    return {"name": name, "unit": rows[0].unit, "low": low, "high": high, "truth": truth}


def _distinct_names(runs: Sequence[Run]) -> list[str]:
    """Folder names, with their parents where two are the same, and numbered if that is not enough."""
    names = [run.name for run in runs]
    if len(set(names)) < len(names):
        names = [f"{run.whole.resolve().parent.name}/{run.name}" for run in runs]
    return names if len(set(names)) == len(names) else [f"{name} ({at})" for at, name in enumerate(names, 1)]


def _notes(runs: Sequence[Run]) -> list[str]:
    """Reasons why these runs are hard to compare."""
    tasks = list(dict.fromkeys(run.spec.task for run in runs))
    notes = [f"The runs are of different robots ({', '.join(tasks)})."] if len(tasks) > 1 else []
    if len({run.spec.data and run.spec.data.fingerprint for run in runs}) > 1:
        notes.append("The runs were calibrated to different data.")
    if any(not run.parameters for run in runs):
        notes.append("Not all of the runs have ended.")
    return notes
