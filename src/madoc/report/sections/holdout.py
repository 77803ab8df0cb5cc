"""What rows that no method has seen say: the verdict's numbers, replays, residuals, the methods compared."""

from collections.abc import Sequence

import numpy as np

from madoc.calibration.holdout import Fitted, NotRun, PredictionError, ToldApart
from madoc.report.charts import Line, line_chart
from madoc.report.reading import Run
from madoc.report.sections.base import TONES, Section, Shown, interval_words
from madoc.report.words import count, duration, number, parameter_title

SIGNALS_SHOWN = 24
"""Signals drawn one by one: those that the calibrated simulator misses most come first."""
WINDOWS_SHOWN = 3
"""Held-out stretches drawn side by side in one chart."""


def holdout(run: Run) -> Section:
    """How far ahead the simulator predicts rows that no method has seen."""
    title, held = "On data it has not seen", run.holdout
    if held is None:
        return Section("holdout", title, "", None, "Nothing was held out to judge the estimate by.")
    facts = [("rows held out", count(held.rows)), ("episodes", count(held.episodes))]
    if not isinstance(held, Fitted):
        areas = (held.area_at_mid_range.area, held.area_at_estimate.area)
        facts.append(("area under a classifier's curve, 0.5 is chance", " → ".join(number(area, 2) for area in areas)))
    rows = [
        {"name": parameter_title(name), "at": round(100 * share, 2)} for name, share in held.interval_shares.items()
    ]
    data: Shown = {"facts": facts, "chart": None, "legend": [], "shares": rows}
    if not isinstance(held, ToldApart) and len(held.errors.estimate) > 1:
        errors = held.errors
        lines = [
            _error_line("mid-range", errors.mid_range, "before"),
            _error_line("what noise alone leaves", errors.noise, "chance", dashed=True),
            _error_line("the best parameters nearby", errors.nearby_best, "g2"),
            _error_line("estimate", errors.estimate, "after"),
        ]
        data["chart"] = line_chart(
            np.array([error.steps for error in errors.estimate], dtype=float),
            lines,
            label="prediction error by horizon",
            x_title="control steps ahead" + (" of a fitted start" if isinstance(held, Fitted) else ""),
            x_words=number,
            log=True,
        )
        data["legend"] = [(line.colour, line.name) for line in lines]
    return Section("holdout", title, f"{held.split[:1].upper()}{held.split[1:]}." if held.split else "", data)


def _error_line(name: str, errors: Sequence[PredictionError], colour: str, *, dashed: bool = False) -> Line:
    """Prediction errors at each horizon, with their intervals."""
    low, high = (np.array([error.interval[end] for error in errors]) for end in (0, 1))
    return Line(name, np.array([error.mean for error in errors]), colour, low, high, dashed=dashed)


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
    data: Shown = {
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
    rows: list[Shown] = [
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
    """Root mean square by signal, in units of its typical change; failed simulations are left out."""
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
    held = run.holdout
    if held is None or not held.candidates:
        return Section("methods", title, lede, None, "One method was asked for, so none were compared.")
    measure = "area of a classifier, less ½" if isinstance(held, ToldApart) else "error, as a share of mid-range's"
    rows = [
        {"name": row.method, "kept": False, "why": row.not_run}
        if isinstance(row, NotRun)
        else {
            "name": row.method,
            "kept": row.method == held.chosen,
            "why": "",
            "score": number(row.score, 3),
            "interval": interval_words(row.interval),
            "verdict": row.verdict.replace("_", " "),
            "tone": TONES[row.verdict],
            "steps": count(row.control_steps),
            "time": duration(row.seconds),
        }
        for row in held.candidates
    ]
    return Section("methods", title, lede, {"rows": rows, "measure": measure})
