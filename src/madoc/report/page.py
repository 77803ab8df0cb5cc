"""The page of a run: one HTML file with all it needs inside, and no script needed to read it."""

import datetime
import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import jinja2

from madoc.errors import MadocError
from madoc.report import sections
from madoc.report.reading import Run, read_run
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


def run_context(run: Run) -> dict[str, Any]:
    """What the template of one run shows."""
    made = [section(run) for section in sections.ALL]
    if not run.parameters:
        made = [replace(each, absent=sections.NOT_ENDED) if each.data is None else each for each in made]
    return {
        "title": f"{run.spec.get('task', 'robot')} · {run.method}",
        "run": run,
        "verdict": verdict_of(run),
        "facts": _facts(run),
        "warnings": run.result.get("warnings", []),
        "sections": made,
        "absent": [section for section in made if section.data is None],
        "ended": _ended(run),
    }


def verdict_of(run: Run) -> dict[str, str]:
    """The word on top, its colour, and its sentence; how the run ended where it was given no verdict."""
    verdict = run.result.get("verdict")
    if verdict:
        word = str(verdict["word"])
        return {
            "word": word.replace("_", " "),
            "tone": sections.TONES.get(word, "doubtful"),
            "sentence": str(verdict["sentence"]),
            "note": str(run.result.get("sentence", "")),
        }
    status = run.result.get("status")
    if status is None or "parameters" not in run.result:
        return {
            "word": "NOT ENDED" if status is None else str(status).upper(),
            "tone": "doubtful",
            "sentence": "The run has not ended: this page shows what it has done so far.",
            "note": str(run.result.get("sentence", "")),
        }
    sentence = {
        "interrupted": "The run was interrupted: the estimate is that of the moment.",
        "diverged": "The run stopped on a number that is none: do not use the estimate.",
    }.get(status, "Nothing was held out, so this estimate was not tried on data it has not seen.")
    return {
        "word": "NO VERDICT" if status in ("finished", "converged") else str(status).upper(),
        "tone": "bad" if status == "diverged" else "doubtful" if status == "interrupted" else "neutral",
        "sentence": sentence,
        "note": str(run.result.get("sentence", "")),
    }


def _facts(run: Run) -> list[dict[str, str]]:
    """The few numbers worth the top of the page."""
    facts = [*_held_out(run)]
    error = run.result.get("error")
    if error:
        facts.append(
            {
                "title": "off the truth",
                "value": f"{number(error['mean_percent_of_range'], 3)} %",
                "note": "of the range, on average",
            }
        )
    if run.result.get("control_steps") is not None:
        facts.append({"title": "control steps", "value": count(run.result["control_steps"]), "note": "simulated"})
    if run.result.get("seconds") is not None:
        facts.append({"title": "time", "value": duration(run.result["seconds"]), "note": "wall clock"})
    data = run.spec.get("data")
    if isinstance(data, dict) and "rows" in data:
        facts.append({"title": "log", "value": count(data["rows"]), "note": f"rows · {data.get('fingerprint', '')}"})
    return facts


def _held_out(run: Run) -> list[dict[str, str]]:
    """The hold-out's measure in one number."""
    held = run.result.get("holdout") or {}
    if held.get("measure") == "prediction" and held.get("relative") is not None:
        ends = [f"{number(100 * end, 3)} %" for end in held["relative_interval"]]
        value, note = f"{number(100 * held['relative'], 3)} %", f"of mid-range's; {ends[0]} to {ends[1]}"
        return [{"title": "error on the hold-out", "value": value, "note": note}]
    area = (held.get("two_sample") or {}).get("estimate")
    if area:
        low, high = (number(end, 2) for end in area["interval"])
        note = f"area of a classifier, {low} to {high}; 0.5 is chance"
        return [{"title": "told from the log", "value": number(area["area"], 2), "note": note}]
    return []


def _ended(run: Run) -> str:
    """When the result was written."""
    file = run.folder / "result.json"
    if not file.exists():
        return ""
    return datetime.datetime.fromtimestamp(file.stat().st_mtime).strftime("%Y-%m-%d %H:%M")


def write_page(page: Path, template: str, context: dict[str, Any]) -> None:
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


def render(template: str, context: dict[str, Any]) -> str:
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
