"""What rows that no method has seen say: the verdict's numbers, replays, residuals, the methods compared."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from madoc.report.charts import Line, line_chart
from madoc.report.reading import Run
from madoc.report.sections.base import TONES, Section, span_words
from madoc.report.words import count, duration, number, parameter_title

SIGNALS_SHOWN = 24
"""Signals drawn one by one: those that the calibrated simulator misses most come first."""
WINDOWS_SHOWN = 3
"""Held-out stretches drawn side by side in one chart."""


def holdout(run: Run) -> Section:
    """How far ahead the simulator predicts rows that no method has seen."""
    title = "On data it has not seen"
    held = run.result.get("holdout")
    if not held:
        return Section("holdout", title, "", None, "Nothing was held out to judge the estimate by.")
    lede = f"Held out: {held['split']}." if held.get("split") else ""
    facts = [("rows held out", count(held["rows"])), ("episodes", count(held["episodes"]))]
    areas = held.get("two_sample") or {}
    if {"mid-range", "estimate"} <= set(areas):
        told = " → ".join(number(areas[name]["area"], 2) for name in ("mid-range", "estimate"))
        facts.append(("area under a classifier's curve, 0.5 is chance", told))
    shares = held.get("interval_share_of_range") or {}
    rows = [{"name": parameter_title(name), "at": round(100 * min(share, 1.0), 2)} for name, share in shares.items()]
    data: dict[str, Any] = {"facts": facts, "chart": None, "legend": [], "shares": rows}
    prediction = held.get("prediction") or {}
    horizons = np.array(held.get("horizons") or [], dtype=float)
    if prediction and len(horizons) > 1:
        kinds = (("mid-range", "before"), ("noise", "chance"), ("nearby best", "g2"), ("estimate", "after"))
        lines = [_errors(name, prediction[name], colour) for name, colour in kinds if name in prediction]
        data["chart"] = line_chart(
            horizons,
            lines,
            label="prediction error by horizon",
            x_title="control steps ahead",
            x_words=number,
            log=True,
        )
        data["legend"] = [(line.colour, line.name) for line in lines]
    return Section("holdout", title, lede, data)


def _errors(name: str, rows: Sequence[dict[str, Any]], colour: str) -> Line:
    """Prediction errors at each horizon, with their intervals."""
    low, high = (np.array([row["interval"][end] for row in rows]) for end in (0, 1))
    words = {"noise": "what noise alone leaves", "nearby best": "the best parameters nearby"}.get(name, name)
    return Line(words, np.array([row["error"] for row in rows]), colour, low, high, dashed=name == "noise")


def signals(run: Run) -> Section:
    """Measured against simulated, signal by signal, on the hold-out."""
    title = "Measured and simulated"
    lede = (
        "Held-out stretches of the log, and the same stretches replayed in the simulator from the same start: "
        "at mid-range, and calibrated."
    )
    evidence = run.evidence
    if evidence is None:
        return Section("signals", title, lede, None, "Nothing was held out, so there is nothing to replay.")
    if evidence.before is None or evidence.after is None:
        absent = "States cannot be rebuilt from what was measured, so no stretch of the log can be replayed."
        return Section("signals", title, lede, None, absent)
    order = np.argsort(-_misses(evidence.after - evidence.measured, evidence.scale))[:SIGNALS_SHOWN]
    windows = min(WINDOWS_SHOWN, len(evidence.measured))
    charts = []
    for signal in order:
        lines = [
            Line(name, _joined(values[:windows, :, signal]), colour, dashed=dashed)
            for name, values, colour, dashed in (
                ("at mid-range", evidence.before, "before", True),
                ("measured", evidence.measured, "measured", False),
                ("calibrated", evidence.after, "after", False),
            )
        ]
        name = evidence.signals[signal]
        chart = line_chart(
            _in_a_row(evidence.time, windows),
            lines,
            label=f"{name}: measured and simulated",
            x_title="time, s (one stretch after another)",
            y_range=_fit(lines),
        )
        charts.append({"title": name, "unit": run.units.get(name, ""), "chart": chart})
    data = {
        "charts": charts,
        "legend": [("measured", "measured"), ("before", "simulated at mid-range"), ("after", "simulated, calibrated")],
        "left_out": len(evidence.signals) - len(order),
    }
    return Section("signals", title, lede, data)


def _in_a_row(time: np.ndarray, windows: int) -> np.ndarray:
    """The times of stretches one after another, and of a gap after each."""
    step = float(np.diff(time).mean()) if len(time) > 1 else 1.0
    one = np.append(time, time[-1] + step)
    return np.concatenate([one + window * (one[-1] - one[0] + step) for window in range(windows)])


def _joined(windows: np.ndarray) -> np.ndarray:
    """Stretches one after another, a gap after each."""
    return np.concatenate([np.append(window, np.nan) for window in windows])


def _fit(lines: Sequence[Line]) -> tuple[float, float] | None:
    """A range for what was measured and calibrated; what runs away at mid-range may leave it by its half."""
    near = np.concatenate([line.y for line in lines if line.colour != "before"])
    every = np.concatenate([line.y for line in lines])
    near, every = near[np.isfinite(near)], every[np.isfinite(every)]
    if not len(near):
        return None
    span = max(float(np.ptp(near)), 1e-12)
    low = max(float(every.min()), float(near.min()) - span)
    high = min(float(every.max()), float(near.max()) + span)
    air = 0.06 * max(high - low, 1e-12)
    return low - air, high + air


def residuals(run: Run) -> Section:
    """How far the simulator is off, signal by signal."""
    title = "Residual by signal"
    lede = (
        "Root mean square of simulated less measured after one control step, on the hold-out, as a share of how much "
        "the signal typically changes in a step."
    )
    evidence = run.evidence
    if evidence is None:
        return Section("residuals", title, lede, None, "Nothing was held out, so there are no residuals.")
    if evidence.residual_before is None or evidence.residual_after is None:
        absent = "States cannot be rebuilt from what was measured, so no single step can be simulated."
        return Section("residuals", title, lede, None, absent)
    before, after = (_misses(each, evidence.scale) for each in (evidence.residual_before, evidence.residual_after))
    largest = float(max(before.max(), after.max())) or 1.0
    rows = [
        {
            "name": evidence.signals[signal],
            "before": _percent(before[signal]),
            "after": _percent(after[signal]),
            "before_at": round(100 * before[signal] / largest, 2),
            "after_at": round(100 * after[signal] / largest, 2),
            "factor": _factor(float(before[signal]), float(after[signal])),
        }
        for signal in np.argsort(-before)
    ]
    return Section("residuals", title, lede, {"rows": rows})


def _misses(residual: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Root mean square by signal, in units of its typical change; rows whose simulation failed count not."""
    squares = residual.reshape(-1, residual.shape[-1]) ** 2
    rows = squares[np.isfinite(squares).all(-1)]
    mean = rows.mean(0) if len(rows) else np.zeros(residual.shape[-1])
    return np.asarray(np.sqrt(mean) / np.where(scale > 0, scale, 1.0))


def _percent(share: float) -> str:
    return f"{number(100 * float(share), 3)} %"


def _factor(before: float, after: float) -> str:
    if before == 0.0 and after == 0.0:
        return "no change"
    if after == 0.0 or before / after > 1e4:
        return "over 10 000 times less"
    ratio = before / after
    if 0.95 < ratio < 1.05:
        return "no change"
    return f"{number(ratio, 2)} times less" if ratio >= 1 else f"{number(1 / max(ratio, 1e-12), 2)} times more"


def methods(run: Run) -> Section:
    """What was tried before the best was kept."""
    title, lede = "Methods compared", "All that were tried, on the same hold-out by the same measure; less is better."
    held = run.result.get("holdout") or {}
    candidates = held.get("candidates")
    if not candidates:
        return Section("methods", title, lede, None, "One method was asked for, so none were compared.")
    measure = "error, as a share of mid-range's" if held.get("measure") == "prediction" else "told apart, area less ½"
    rows = [
        {
            "name": row["method"],
            "kept": row["method"] == held.get("chosen"),
            "why": row.get("not_run", ""),
            "score": number(row.get("score"), 3),
            "interval": span_words(row["interval"]) if "interval" in row else "",
            "verdict": row.get("verdict", "").replace("_", " "),
            "tone": TONES.get(row.get("verdict", ""), "neutral"),
            "steps": count(row["control_steps"]) if "control_steps" in row else "",
            "time": duration(row["seconds"]) if "seconds" in row else "",
        }
        for row in candidates
    ]
    return Section("methods", title, lede, {"rows": rows, "measure": measure})
