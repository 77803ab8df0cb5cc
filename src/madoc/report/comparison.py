"""Several runs on one page."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from madoc.errors import MadocError
from madoc.report.page import verdict_of, write_page
from madoc.report.reading import Run, read_run
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


def comparison_context(runs: Sequence[Run]) -> dict[str, Any]:
    """What the template of several runs shows."""
    names = _distinct_names(runs)
    tasks = list(dict.fromkeys(str(run.spec.get("task", "")) for run in runs))
    rows = [_run_row(run, name, index) for index, (run, name) in enumerate(zip(runs, names, strict=True))]
    return {
        "title": f"{len(runs)} runs compared",
        "rows": rows,
        "notes": _notes(runs, tasks),
        "parameters": _parameter_rows(runs, names),
        "costs": _bars(rows, runs, "seconds"),
        "errors": _bars(rows, runs, "error"),
    }


def _run_row(run: Run, name: str, index: int) -> dict[str, Any]:
    error, held = run.result.get("error") or {}, run.result.get("holdout") or {}
    return {
        "name": name,
        "colour": f"g{index % 8}",
        "verdict": verdict_of(run),
        "method": run.method,
        "holdout": number(100 * held["relative"], 3) if held.get("measure") == "prediction" else "–",
        "task": run.spec.get("task", ""),
        "error": number(error.get("mean_percent_of_range"), 3),
        "steps": count(run.result["control_steps"]) if "control_steps" in run.result else "–",
        "time": duration(run.result["seconds"]) if "seconds" in run.result else "–",
        "seed": run.spec.get("seed", "–"),
        "warnings": run.result.get("warnings", []),
    }


def _parameter_rows(runs: Sequence[Run], names: Sequence[str]) -> list[dict[str, Any]]:
    """Each parameter with a lane a run, on an axis that holds all their ranges."""
    found = []
    for parameter in dict.fromkeys(name for run in runs for name in run.parameters):
        own = [(index, run.parameters[parameter], run) for index, run in enumerate(runs) if parameter in run.parameters]
        low, high = min(row["low"] for _, row, _ in own), max(row["high"] for _, row, _ in own)

        def place(value: float, low: float = low, high: float = high) -> float:
            return round(min(max((value - low) / (high - low), 0.0), 1.0) * 100, 3)

        truth = next((run.truth[parameter] for _, _, run in own if parameter in run.truth), None)
        lanes = []
        for index, row, _ in own:
            ends = row.get("interval") or (row["estimate"] - row["std"], row["estimate"] + row["std"])
            lanes.append(
                {
                    "name": names[index],
                    "colour": f"g{index % 8}",
                    "estimate": number(row["estimate"]),
                    "at": place(row["estimate"]),
                    "from": place(ends[0]),
                    "to": place(ends[1]),
                }
            )
        found.append(
            {
                "title": parameter_title(parameter),
                "name": parameter,
                "unit": own[0][1]["unit"].replace("1", "") if own[0][1]["unit"] == "1" else own[0][1]["unit"],
                "low": number(low),
                "high": number(high),
                "truth": None if truth is None else number(truth),
                "truth_at": None if truth is None else place(truth),
                "lanes": lanes,
            }
        )
    return found


def _bars(rows: Sequence[dict[str, Any]], runs: Sequence[Run], what: str) -> list[dict[str, Any]]:
    """A bar a run, for those that say; empty where none does."""
    values = [
        run.result.get("seconds") if what == "seconds" else (run.result.get("error") or {}).get("mean_percent_of_range")
        for run in runs
    ]
    largest = max((value for value in values if value is not None), default=0.0) or 1.0
    return [
        {
            "name": row["name"],
            "colour": row["colour"],
            "at": round(100 * value / largest, 2),
            "words": duration(value) if what == "seconds" else f"{number(value, 3)} % of the range",
        }
        for row, value in zip(rows, values, strict=True)
        if value is not None
    ]


def _distinct_names(runs: Sequence[Run]) -> list[str]:
    """Folder names; with those of their parents where two are alike."""
    names = [run.name for run in runs]
    if len(set(names)) == len(names):
        return names
    return [f"{run.whole.resolve().parent.name}/{run.name}" for run in runs]


def _notes(runs: Sequence[Run], tasks: Sequence[str]) -> list[str]:
    """What makes these runs hard to compare."""
    notes = []
    if len(tasks) > 1:
        notes.append(f"The runs are of different robots ({', '.join(tasks)}).")
    data = {(run.spec.get("data") or {}).get("fingerprint") for run in runs}
    if len(data) > 1:
        notes.append("The runs were calibrated to different data.")
    if any(not run.parameters for run in runs):
        notes.append("Not all of the runs have ended.")
    return notes
