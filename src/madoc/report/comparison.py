"""Several runs on one page."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from madoc.calibration.holdout import ToldApart
from madoc.errors import MadocError
from madoc.report.page import headline, write_page
from madoc.report.reading import Run, read_run
from madoc.report.sections.base import Shown, place, spread_of, unit_words
from madoc.report.words import count, duration, number, parameter_title


def write_comparison(runs: Sequence[Path], out: Path | None = None) -> Path:
    """Write one page on several runs: estimates side by side, error, cost, verdict.

    Args:
        runs: Folders of `madoc calibrate` or `madoc run`.
        out: The page; None takes `comparison.html` in the working directory.

    Raises:
        MadocError: A run cannot be read, or the page cannot be written.
    """
    if len(runs) < 2:
        raise MadocError(f"expected at least 2 runs to compare, got {len(runs)}")
    page = (out or Path("comparison.html")).expanduser()
    write_page(page, "comparison.html", comparison_context([read_run(run) for run in runs]))
    return page


def comparison_context(runs: Sequence[Run]) -> Shown:
    """What the template of several runs shows."""
    names = dict(zip(_distinct_names(runs), runs, strict=True))
    parameters = dict.fromkeys(name for run in runs for name in run.parameters)
    seconds = {name: run.result.seconds if run.result else None for name, run in names.items()}
    errors = {name: run.error_percent for name, run in names.items()}
    return {
        "title": f"{len(runs)} runs compared",
        "rows": [_run_row(run, name, index) for index, (name, run) in enumerate(names.items())],
        "notes": _notes(runs),
        "parameters": [_parameter_row(parameter, names) for parameter in parameters],
        "costs": _bars(seconds, duration),
        "errors": _bars(errors, lambda value: f"{number(value, 3)} % of the range"),
    }


def _run_row(run: Run, name: str, index: int) -> Shown:
    held, result = run.holdout, run.result
    return {
        "name": name,
        "colour": f"g{index % 8}",
        "verdict": headline(run),
        "method": run.method,
        "holdout": "–" if held is None or isinstance(held, ToldApart) else number(100 * held.score, 3),
        "task": run.spec.task,
        "error": number(run.error_percent, 3),
        "steps": "–" if result is None else count(result.control_steps),
        "time": "–" if result is None else duration(result.seconds),
        "seed": "–" if run.spec.seed is None else run.spec.seed,
        "warnings": run.warnings,
    }


def _parameter_row(parameter: str, runs: Mapping[str, Run]) -> Shown:
    """A parameter with a lane a run, on an axis that holds all their ranges."""
    own = [
        (name, f"g{index % 8}", run.parameters[parameter])
        for index, (name, run) in enumerate(runs.items())
        if parameter in run.parameters
    ]
    span = min(row.low for *_, row in own), max(row.high for *_, row in own)
    truth = next((run.truth[parameter] for run in runs.values() if parameter in run.truth), None)
    lanes = [
        {
            "name": name,
            "colour": colour,
            "estimate": number(row.estimate),
            "at": place(row.estimate, *span),
            "from": place(spread_of(row)[0], *span),
            "to": place(spread_of(row)[1], *span),
        }
        for name, colour, row in own
    ]
    return {
        "title": parameter_title(parameter),
        "unit": unit_words(own[0][2].unit),
        "low": number(span[0]),
        "high": number(span[1]),
        "truth": None if truth is None else number(truth),
        "truth_at": None if truth is None else place(truth, *span),
        "lanes": lanes,
    }


def _bars(values: Mapping[str, float | None], words: Callable[[float], str]) -> list[Shown]:
    """A bar for every run that has a value."""
    largest = max((value for value in values.values() if value is not None), default=0.0) or 1.0
    return [
        {"name": name, "colour": f"g{index % 8}", "at": round(100 * value / largest, 2), "words": words(value)}
        for index, (name, value) in enumerate(values.items())
        if value is not None
    ]


def _distinct_names(runs: Sequence[Run]) -> list[str]:
    """Folder names; where two are alike with those of their parents, and numbered if that is not enough."""
    names = [run.name for run in runs]
    if len(set(names)) < len(names):
        names = [f"{run.whole.resolve().parent.name}/{run.name}" for run in runs]
    return names if len(set(names)) == len(names) else [f"{name} ({at})" for at, name in enumerate(names, 1)]


def _notes(runs: Sequence[Run]) -> list[str]:
    """What makes these runs hard to compare."""
    tasks = list(dict.fromkeys(run.spec.task for run in runs))
    notes = [f"The runs are of different robots ({', '.join(tasks)})."] if len(tasks) > 1 else []
    if len({run.spec.data and run.spec.data.fingerprint for run in runs}) > 1:
        notes.append("The runs were calibrated to different data.")
    if any(not run.parameters for run in runs):
        notes.append("Not all of the runs have ended.")
    return notes
