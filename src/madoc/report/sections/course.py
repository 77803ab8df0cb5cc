"""The course of the run: the trace of the estimates, and the curves of the method's own metrics."""

from dataclasses import dataclass

import numpy as np

from madoc.report.charts import Level, Line, line_chart, thinned
from madoc.report.reading import MetricLog, Run
from madoc.report.words import metric_title


@dataclass(frozen=True)
class Panel:
    """Metrics that are shown in one chart."""

    title: str
    metrics: tuple[str, ...]
    y_range: tuple[float, float] | None = None
    levels: tuple[Level, ...] = ()
    log: bool = False


_PANELS = (
    Panel(
        "How well discriminators tell logged rows from simulated",
        ("accuracy_sa", "accuracy_sas"),
        (0.4, 1.0),
        (Level(0.5, "chance", "chance"),),
    ),
    Panel("Loss of the discriminators", ("discriminator_loss_sa", "discriminator_loss_sas")),
    Panel("Reward: the log dynamics ratio", ("reward", "reward_size")),
    Panel("Mismatch, and the blur that measures it", ("mismatch", "blur"), log=True),
    Panel("Rows that count, rows at the reward's bound", ("overlap", "reward_at_bound"), (0.0, 1.0)),
    Panel("Spread of the actors, as a share of half the range", ("actor_std",)),
)
"""The charts of known metrics, in this order; every other metric has a chart of its own, folded away."""


def trace(run: Run) -> dict[str, object] | str:
    """The estimate of every parameter over the run."""
    log, ranges = run.log, _ranges(run)
    names = [] if log is None else [name for name in ranges if f"estimate/{name}" in log.metrics]
    if log is None or not names:
        return "This run wrote no estimates into its log while it went."
    charts = [chart for name in names if (chart := _trace_chart(run, log, name, *ranges[name]))]
    if not charts:
        return "The run had too few epochs to draw a trace of."
    return {"charts": charts, "legend": [("truth", "truth")] if run.truth else []}


def _trace_chart(run: Run, log: MetricLog, name: str, low: float, high: float, unit: str) -> dict[str, object] | None:
    """One parameter's estimate and its standard deviation; None where it has fewer than two points."""
    estimate = log.metrics[f"estimate/{name}"]
    known = np.isfinite(estimate)
    if known.sum() < 2:
        return None
    spent, x_title = _axis(log, known)
    x, mean, _, _ = thinned(spent, estimate[known])
    std = log.metrics.get(f"std/{name}", np.full(len(estimate), np.nan))[known]
    spread = thinned(spent, std)[1]
    ends = np.maximum(mean - spread, low), np.minimum(mean + spread, high)
    line = Line("estimate", mean, run.colour(name), *ends)
    chart = line_chart(
        x,
        [line],
        label=f"{name} over the run",
        x_title=x_title,
        y_range=(low, high),
        levels=[Level(run.truth[name], "truth")] if name in run.truth else [],
    )
    return {"title": name, "unit": unit, "chart": chart}


def _ranges(run: Run) -> dict[str, tuple[float, float, str]]:
    """Range and unit of each parameter; the range alone, from what was asked, while there is no result."""
    if run.parameters:
        return {name: (row.low, row.high, row.unit) for name, row in run.parameters.items()}
    return {name: (*span, "") for name, span in run.spec.parameters.items() if isinstance(span, tuple)}


def curves(run: Run) -> dict[str, object] | str:
    """What the method measured of itself."""
    log = run.log
    if log is None:
        return "The run kept no log of its metrics."
    in_panels = {name for panel in _PANELS for name in panel.metrics}
    charts = [drawn for panel in _PANELS if (drawn := _panel(log, panel))]
    rest = [name for name in log.metrics if name not in in_panels and not name.startswith(("estimate/", "std/"))]
    others = [drawn for name in rest if (drawn := _panel(log, Panel(metric_title(name), (name,))))]
    if not charts and not others:
        return "The run had too few epochs to draw a curve of."
    return {"charts": charts, "others": others}


def _panel(log: MetricLog, panel: Panel) -> dict[str, object] | None:
    """A chart of some metrics; None where the run has fewer than two points of each."""
    present = [name for name in panel.metrics if name in log.metrics]
    known = np.zeros(len(log), dtype=bool)
    for name in present:
        known |= np.isfinite(log.metrics[name])
    if known.sum() < 2:
        return None
    spent, x_title = _axis(log, known)
    values = np.concatenate([log.metrics[name][known] for name in present])
    values = values[np.isfinite(values)]
    log_scale = bool(panel.log or (panel.y_range is None and (values > 0).all() and values.max() > 300 * values.min()))
    lines = []
    for index, name in enumerate(present):
        x, y, low, high = thinned(spent, log.metrics[name][known])
        lines.append(Line(metric_title(name), y, f"g{index}", low, high))
    chart = line_chart(
        x,
        lines,
        label=panel.title,
        x_title=x_title,
        y_range=panel.y_range,
        levels=panel.levels,
        log=log_scale,
    )
    legend = [(line.colour, line.name) for line in lines] if len(lines) > 1 else []
    legend += [(level.colour, level.name) for level in panel.levels]
    return {"title": panel.title, "unit": "", "chart": chart, "legend": legend}


def _axis(log: MetricLog, known: np.ndarray) -> tuple[np.ndarray, str]:
    """The horizontal axis of a curve and its title: what was spent, or epochs where nothing was."""
    spent = log.spent[known]
    if spent[-1] > spent[0]:
        return spent, log.unit
    return np.arange(1, len(spent) + 1, dtype=float), f"epoch of {log.stage[int(np.flatnonzero(known)[0])]}"
