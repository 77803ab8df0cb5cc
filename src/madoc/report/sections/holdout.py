"""The estimate on held-out data: the verdict's numbers, replays and residuals."""

from collections.abc import Sequence

import numpy as np

from madoc.calibration.holdout import Fitted, PredictionError, ToldApart
from madoc.report.charts import Line, line_chart
from madoc.report.reading import Run
from madoc.report.words import count, number

SIGNALS_SHOWN = 24
"""Largest number of signals that are drawn; of more, those with the largest residuals at the estimate are."""
WINDOWS_SHOWN = 3
"""Largest number of held-out windows in one chart, one after another."""


def holdout(run: Run) -> dict[str, object] | str:
    """How well the simulator predicts held-out data."""
    held = run.holdout
    if held is None:
        return "Nothing was held out to judge the estimate by."
    facts = [("rows held out", count(held.rows)), ("episodes", count(held.episodes))]
    if not isinstance(held, Fitted):
        areas = (held.area_at_mid_range.area, held.area_at_estimate.area)
        facts.append(("area under a classifier's curve, 0.5 is chance", " → ".join(number(area, 2) for area in areas)))
    data: dict[str, object] = {"facts": facts, "chart": None, "legend": [], "held": held, "units": run.units}
    if isinstance(held, ToldApart) or len(held.errors.estimate) < 2:
        return data
    errors = held.errors
    lines = [
        _error_line("mid-range", errors.mid_range, "before"),
        _error_line("what noise alone leaves", errors.noise, "chance", dashed=True),
        _error_line("the best parameters nearby", errors.nearby_best, "g2"),
        _error_line("estimate", errors.estimate, "after"),
    ]
    chart = line_chart(
        np.array([error.steps for error in errors.estimate], dtype=float),
        lines,
        label="prediction error by horizon",
        x_title="control steps ahead" + (" of a fitted start" if isinstance(held, Fitted) else ""),
        x_words=number,
        log=True,
    )
    unit = "a step" if errors.stride == 1 else f"{errors.stride} steps"
    return data | {"chart": chart, "legend": [(line.colour, line.name) for line in lines], "unit": unit}


def _error_line(name: str, errors: Sequence[PredictionError], colour: str, *, dashed: bool = False) -> Line:
    """Prediction errors at each horizon, with their intervals."""
    low, high = (np.array([error.interval[end] for error in errors]) for end in (0, 1))
    return Line(name, np.array([error.mean for error in errors]), colour, low, high, dashed=dashed)


def signals(run: Run) -> dict[str, object] | str:
    """Measured against simulated on the hold-out, signal by signal."""
    evidence = run.evidence
    if evidence is None:
        return "Nothing was held out, so there is nothing to replay."
    if evidence.before is None or evidence.after is None:
        return "States cannot be rebuilt from what was measured, so no stretch of the log can be replayed."
    order = np.argsort(-_error(evidence.after - evidence.measured, evidence.scale))[:SIGNALS_SHOWN]
    windows = min(WINDOWS_SHOWN, len(evidence.measured))
    charts = []
    for signal in order:
        lines = [
            Line(name, _joined(values[:windows, :, signal]), colour, dashed=dashed)
            for name, values, colour, dashed in (
                ("your model as given", evidence.before, "before", True),
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
    legend = [("measured", "measured"), ("before", "your model as given"), ("after", "simulated, calibrated")]
    return {"charts": charts, "legend": legend, "omitted": len(evidence.signals) - len(order)}


def _in_a_row(time: np.ndarray, windows: int) -> np.ndarray:
    """The times of windows one after another, and of a gap after each."""
    step = float(np.diff(time).mean()) if len(time) > 1 else 1.0
    one = np.append(time, time[-1] + step)
    return np.concatenate([one + window * (one[-1] - one[0] + step) for window in range(windows)])


def _joined(windows: np.ndarray) -> np.ndarray:
    """Windows one after another, a gap after each."""
    return np.concatenate([np.append(window, np.nan) for window in windows])


def _fit(lines: Sequence[Line]) -> tuple[float, float] | None:
    """The range of all but the model as given, which may extend it by its own width at most to either side."""
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


def residuals(run: Run) -> dict[str, object] | str:
    """Residuals of one control step, signal by signal."""
    evidence = run.evidence
    if evidence is None:
        return "Nothing was held out, so there are no residuals."
    if evidence.residual_before is None or evidence.residual_after is None:
        return "States cannot be rebuilt from what was measured, so no single step can be simulated."
    before, after = (_error(each, evidence.scale) for each in (evidence.residual_before, evidence.residual_after))
    rows = [
        (evidence.signals[signal], float(before[signal]), float(after[signal]), _factor(before[signal], after[signal]))
        for signal in np.argsort(-before)
    ]
    return {"rows": rows, "largest": float(max(before.max(), after.max())) or 1.0}


def _error(residual: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Root mean square residual of each signal in units of its typical change, without failed simulations."""
    squares = residual.reshape(-1, residual.shape[-1]) ** 2
    rows = squares[np.isfinite(squares).all(-1)]
    mean = rows.mean(0) if len(rows) else np.zeros(residual.shape[-1])
    return np.asarray(np.sqrt(mean) / np.where(scale > 0, scale, 1.0))


def _factor(before: float, after: float) -> str:
    """How many times smaller an error has become, in words."""
    if before == after == 0.0:
        return "no change"
    if after == 0.0 or before / after > 1e4:
        return "over 10 000 times less"
    ratio = before / after
    if 0.95 < ratio < 1.05:
        return "no change"
    return f"{number(ratio, 2)} times less" if ratio >= 1 else f"{number(1 / max(ratio, 1e-12), 2)} times more"
