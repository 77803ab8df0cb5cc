"""Several runs on one page."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from madoc.errors import MadocError
from madoc.report.page import headline, write_page
from madoc.report.reading import Run, read_run


def write_comparison(runs: Sequence[Path], out: Path | None = None) -> Path:
    """Write one page on several runs; by default it is `comparison.html` in the working directory.

    Raises:
        MadocError: A run cannot be read, or the page cannot be written.
    """
    if len(runs) < 2:
        raise MadocError(f"expected at least 2 runs to compare, got {len(runs)}")
    page = (out or Path("comparison.html")).expanduser()
    write_page(page, "comparison.html", _context([read_run(run) for run in runs]))
    return page


def _context(runs: Sequence[Run]) -> dict[str, object]:
    """What the template of several runs shows."""
    names = dict(zip(_distinct_names(runs), runs, strict=True))
    parameters = dict.fromkeys(name for run in runs for name in run.parameters)
    return {
        "title": f"{len(runs)} runs compared",
        "runs": names,
        "colours": {name: f"g{index % 8}" for index, name in enumerate(names)},
        "headline": headline,
        "notes": _notes(runs),
        "parameters": [_parameter(parameter, names) for parameter in parameters],
        "costs": {name: run.result.seconds for name, run in names.items() if run.result},
        "errors": {name: run.error_percent for name, run in names.items() if run.error_percent is not None},
    }


def _parameter(name: str, runs: Mapping[str, Run]) -> dict[str, object]:
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
