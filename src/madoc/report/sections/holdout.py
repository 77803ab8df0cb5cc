"""The estimate on held-out data: the verdict's numbers, replays and residuals."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Int
from markupsafe import Markup

from madoc.calibration.holdout import Fitted, PredictionError, ToldApart
from madoc.report.charts import Line, drawn, line_chart, rounded
from madoc.report.reading import Evidence, Run
from madoc.report.words import count, number

SIGNALS_SHOWN = 24
"""Largest number of signals that are drawn; of more, those with the largest residuals at the estimate are."""
NUMBERS = 250_000
"""Largest number of values of all lines of signals, 2 MB of the page; of more, every second row is drawn, or third."""


def holdout(run: Run) -> dict[str, object] | str:
    """How well the simulator predicts held-out data."""
    held = run.holdout
    if held is None:
        return "Nothing was held out to judge the estimate by."
    facts = [("rows held out", count(held.rows)), ("episodes", count(held.episodes))]
    if isinstance(held, ToldApart):
        areas = (held.area_at_mid_range.area, held.area_at_estimate.area)
        told = "how well a classifier tells simulated from logged motion, mid-range → calibrated (0.5: not at all)"
        facts.append((told, " → ".join(number(area, 2) for area in areas)))
    data: dict[str, object] = {"facts": facts, "chart": None, "legend": [], "held": held, "units": run.units}
    if isinstance(held, ToldApart) or len(held.errors.estimate) < 2:
        return data
    errors = held.errors
    lines = [
        _error_line("mid-range", errors.mid_range, "g3"),
        _error_line("what noise alone leaves", errors.noise, "chance", dashed=True),
        _error_line("fitted to the hold-out", errors.nearby_best, "g2"),
        _error_line("estimate", errors.estimate, "after"),
    ]
    chart = line_chart(
        np.array([error.steps for error in errors.estimate], dtype=float),
        lines,
        label="prediction error by horizon",
        x_title="control steps ahead" + (" of a fitted start" if isinstance(held, Fitted) else ""),
        log=True,
    )
    unit = "a step" if errors.stride == 1 else f"{errors.stride} steps"
    return data | {
        "chart": chart,
        "legend": [(line.colour, f"{line.name}: {number(line.y[-1], 2)}") for line in lines],
        "unit": unit,
    }


def _error_line(name: str, errors: Sequence[PredictionError], colour: str, *, dashed: bool = False) -> Line:
    """Prediction errors at each horizon, with their intervals."""
    low, high = (np.array([error.interval[end] for error in errors]) for end in (0, 1))
    return Line(name, np.array([error.mean for error in errors]), colour, low, high, dashed=dashed)


def signals(run: Run) -> dict[str, object] | str:
    """Measured against simulated in whole held-out runs, signal by signal, with residuals."""
    evidence = run.evidence
    if evidence is None:
        return "Nothing was held out, so there is nothing to replay."
    if evidence.before is None or evidence.after is None:
        return "Positions cannot be told from what was measured, so no run can be replayed."
    if len(evidence.time) < 3:
        return "The rows of the log are not in order, so no run can be replayed."
    worst = np.argsort(-_error(evidence.after - evidence.measured, evidence.scale))[:SIGNALS_SHOWN]
    every = -(-evidence.measured[..., worst].size * len(_LINES) // NUMBERS)
    names = [(index, evidence.signals[index]) for index in sorted(worst.tolist())]
    whole = np.isfinite(evidence.measured).all(-1).sum(1)
    charts = [
        {"title": name, "unit": run.units.get(name, ""), "chart": _replayed(evidence, index, every, whole)}
        for index, name in names
    ]
    legend = [("measured", "measured"), ("before", "your model as given"), ("after", "calibrated")]
    fitted = evidence.fitted * float(evidence.time[1])
    shown = {"charts": charts, "legend": legend, "omitted": len(evidence.signals) - len(worst), "every": every}
    return shown | {"names": evidence.names, "chosen": int(whole.argmax()), "fitted": fitted}


LEFT, LEAST = 2.0, 0.02
"""Ranges of the calibrated model's residuals, and share of the signal's, by which those of the model as given extend
their axis at most, each way: else it would show the calibrated ones as a flat line."""
_LINES = (
    ("measured", "measured", {"width": 6}, 0.4, "y"),
    ("before", "your model as given", {"width": 1.5, "dash": "dash"}, 1.0, "y"),
    ("after", "calibrated", {"width": 2}, 1.0, "y"),
    ("before", "your model as given, less measured", {"width": 1.5, "dash": "dash"}, 1.0, "y2"),
    ("after", "calibrated, less measured", {"width": 2}, 1.0, "y2"),
)
"""Array and colour of each line of a signal, what it is, pen, opacity and axis; the last on top."""


def _replayed(evidence: Evidence, signal: int, every: int, whole: Int[np.ndarray, " runs"]) -> Markup:
    """One signal in all runs, of which the page shows the longest until a reader chooses another.

    `whole` is the number of readings of each run.
    """
    arrays = {"measured": evidence.measured, "before": evidence.before, "after": evidence.after}
    of_signal = {name: each[:, :, signal] for name, each in arrays.items() if each is not None}
    data: list[Mapping[str, object]] = []
    chosen = int(whole.argmax())
    ranges: dict[str, list[tuple[float, float]]] = {"xaxis": [], "yaxis": [], "yaxis2": []}
    for run in range(len(evidence.measured)):
        ranges["xaxis"].append((0.0, float(evidence.time[max(whole[run] - 1, 1)])))
        values = {name: each[run] for name, each in of_signal.items()}
        missed = {name: values[name] - values["measured"] for name in ("before", "after")}
        width = float(np.ptp(values["measured"][np.isfinite(values["measured"])]))
        ranges["yaxis"].append(_fit([values["measured"], values["after"]], values["before"], width))
        left = missed["after"][np.isfinite(missed["after"])]
        far = max(LEFT * float(np.ptp(left)) if len(left) else 0.0, LEAST * width)
        ranges["yaxis2"].append(_fit([left], missed["before"], far))
        for array, name, pen, opacity, axis in _LINES:
            y = rounded((values if axis == "y" else missed)[array][::every])
            step = {"x0": 0.0, "dx": float(evidence.time[1]) * every, "y": y, "yaxis": axis}
            look = {"mode": "lines", "line": pen | {"color": f"var(--{array})"}, "opacity": opacity}
            data.append(step | look | {"name": name, "meta": run, "visible": run == chosen})
    layout = {
        "height": 300,
        "hovermode": "x unified",
        "xaxis": {"title": {"text": "time, s"}, "anchor": "y2", "range": ranges["xaxis"][chosen]},
        "yaxis": {"domain": [0.36, 1.0], "range": ranges["yaxis"][chosen]},
        "yaxis2": {"domain": [0.0, 0.26], "range": ranges["yaxis2"][chosen], "nticks": 6},
        "meta": ranges,
    }
    return drawn({"data": data, "layout": layout}, f"{evidence.signals[signal]}: measured and simulated")


def _fit(near: Sequence[np.ndarray], far: np.ndarray, most: float) -> tuple[float, float]:
    """The range of what is near, and of what is far as much as extends it by `most` to either side."""
    shown, far = (part[np.isfinite(part)] for part in (np.concatenate(near), far))
    if not len(shown):
        return -1.0, 1.0
    every = np.append(shown, np.clip(far, shown.min() - most, shown.max() + most))
    low, high = float(every.min()), float(every.max())
    air = 0.06 * max(high - low, 1e-9)
    return low - air, high + air


def residuals(run: Run) -> dict[str, object] | str:
    """Residuals of single steps of the robot, signal by signal."""
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
    stride = 1 if run.holdout is None or isinstance(run.holdout, ToldApart) else run.holdout.errors.stride
    ahead = "a row" if stride == 1 else f"{stride} rows"
    return {"rows": rows, "largest": float(max(before.max(), after.max())) or 1.0, "ahead": ahead}


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
