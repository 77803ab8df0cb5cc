"""A diagnosis as JSON, and as tables to read."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
from rich import box
from rich.console import RenderableType
from rich.table import Table

from madoc.data.findings import LEVELS, Finding
from madoc.diagnosis.channels import Channel
from madoc.diagnosis.diagnosis import Diagnosis
from madoc.diagnosis.excitation import Excitation
from madoc.diagnosis.explanation import Explanation
from madoc.parameters import ParameterSpace

MOST_ALIKE = 4
"""Largest number of findings with the same advice that are printed; `--json` has all."""


def to_json(diagnosis: Diagnosis, space: ParameterSpace) -> dict[str, object]:
    """The whole diagnosis; null stands for numbers that could not be computed."""
    excitation, signals = diagnosis.excitation, _signals(diagnosis)
    counts = ("rows", "episodes", "runs", "control_step", "fatal")
    channels = [asdict(channel) for channel in diagnosis.channels]
    for channel in channels:
        del channel["at_limits" if channel["kind"] == "signal" else "resolution"]
    parameters = None
    if excitation is not None:
        columns = zip(space.parameters, _finite(excitation.effect), _finite(excitation.half_width), strict=True)
        parameters = {
            row.name: {"unit": row.unit, "low": row.low, "high": row.high, "effect": effect, "half_width": width}
            for row, effect, width in columns
        }
    return {
        **{name: getattr(diagnosis, name) for name in counts},
        "findings": [finding.to_json() for finding in diagnosis.findings],
        "channels": channels,
        "explanation": None if diagnosis.explanation is None else _explanation_json(diagnosis.explanation, signals),
        "parameters": parameters,
        "pairs": [] if excitation is None else [list(pair) for pair in excitation.pairs],
        "control_steps": diagnosis.control_steps,
        "seconds": round(diagnosis.seconds, 3),
    }


def _explanation_json(explanation: Explanation, signals: list[str]) -> dict[str, object]:
    def of(draw: int) -> dict[str, list[float | None]]:
        by_signal = {signal: _finite(explanation.errors[draw, :, at]) for at, signal in enumerate(signals)}
        return by_signal | {"overall": _finite(explanation.overall[draw])}

    return {"horizons": list(explanation.horizons), "midrange": of(0), "best_draw": of(explanation.best)}


def tables(diagnosis: Diagnosis, space: ParameterSpace) -> tuple[RenderableType, ...]:
    """The log, its channels, the model's prediction errors, the expected intervals of parameters, and the findings."""
    seconds, runs, episodes = diagnosis.rows * diagnosis.control_step, diagnosis.runs, diagnosis.episodes
    line = (
        f"{diagnosis.rows:,} rows in {runs} run{'s' * (runs != 1)} ({episodes} stretch{'es' * (episodes != 1)} without "
        f"a break), {diagnosis.control_step:g} s apart: {seconds:,.1f} s"
    )
    parts: list[RenderableType] = [line, _channel_table(diagnosis.channels)]
    if diagnosis.explanation is not None:
        parts.append(_explanation_table(diagnosis.explanation, _signals(diagnosis)))
    if diagnosis.excitation is not None:
        parts.append(_parameter_table(diagnosis.excitation, space))
    return (*parts, *_finding_lines(diagnosis.findings))


def _signals(diagnosis: Diagnosis) -> list[str]:
    return [channel.name for channel in diagnosis.channels if channel.kind == "signal"]


def _channel_table(channels: tuple[Channel, ...]) -> Table:
    table = _table(
        "channels", ("channel", "unit"), ("lowest", "highest", "typical change", "read in steps of", "at limits")
    )
    for row in channels:
        steps = f"{row.resolution:.3g}" if row.resolution else ""
        limits = f"{100 * row.at_limits:.1f} %" if row.kind == "action" else ""
        table.add_row(row.name, row.unit, f"{row.low:.4g}", f"{row.high:.4g}", f"{row.step:.3g}", steps, limits)
    return table


def _explanation_table(explanation: Explanation, signals: list[str]) -> Table:
    first, *others = map(str, explanation.horizons)
    ahead, both = ", ".join((first, *others)), (0, explanation.best)
    numbers = [
        heading
        for where in ("mid-range", f"best of {len(explanation.draws)} draws")
        for heading in (f"{where}: {first}", *others)
    ]
    table = _table(f"prediction errors {ahead} steps ahead, in % of what 'nothing changes' errs", ("signal",), numbers)
    for at, name in enumerate(signals):
        table.add_row(name, *(_percent(value) for draw in both for value in explanation.errors[draw, :, at]))
    table.add_row("all", *(_percent(value) for draw in both for value in explanation.overall[draw]))
    return table


def _parameter_table(excitation: Excitation, space: ParameterSpace) -> Table:
    numbers = ("range", "effect of half of it", "expected 95 %", "its width, of range")
    title = "how well this log determines each parameter, by windows of at most 20 steps (longer ones may do better)"
    table = _table(title, ("parameter", "unit"), numbers)
    for row, effect, width in zip(space.parameters, excitation.effect, excitation.half_width, strict=True):
        cells = (f"{effect:.3g} × noise", f"± {width:.2g}", f"{min(200 * width / (row.high - row.low), 100):.3g} %")
        cells = cells if math.isfinite(width) else ("?", "?", "?")
        table.add_row(row.name, row.unit, f"[{row.low:g}, {row.high:g}]", *cells)
    return table


def _finding_lines(findings: tuple[Finding, ...]) -> tuple[str, ...]:
    counts = Counter(finding.level for finding in findings)
    warned = any(finding.level != "note" for finding in findings)
    parts = [f"{counts[level]} {level}{'s' if counts[level] > 1 and level != 'fatal' else ''}" for level in LEVELS]
    lines = [", ".join(part for level, part in zip(LEVELS, parts, strict=True) if counts[level])]
    lines = lines if warned else ["nothing to warn of"]
    alike = Counter[tuple[str, str]]()
    for finding in findings:
        kind = (finding.level, finding.do)
        alike[kind] += 1
        if alike[kind] <= MOST_ALIKE:
            lines.append(f"{finding.level}: {finding.sentence}")
    hidden = sum(count - MOST_ALIKE for count in alike.values() if count > MOST_ALIKE)
    return (*lines, f"... and {hidden} more like these: --json has all") if hidden else tuple(lines)


def _table(title: str, texts: Sequence[str], numbers: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    for heading in texts:
        table.add_column(heading, no_wrap=True)
    for heading in numbers:
        table.add_column(heading, justify="right")
    return table


def _percent(value: float) -> str:
    return f"{100 * value:.3g} %" if math.isfinite(value) else ""


def _finite(values: np.ndarray) -> list[float | None]:
    return [float(value) if math.isfinite(value) else None for value in values]
