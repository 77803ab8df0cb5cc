"""A diagnosis as JSON, and as tables to read."""

import math
from collections import Counter
from typing import Any

import numpy as np
from rich import box
from rich.console import RenderableType
from rich.table import Table

from madoc.data.findings import LEVELS
from madoc.diagnosis.diagnosis import Diagnosis
from madoc.parameters import ParameterSpace

MOST_ALIKE = 4
"""Findings with the same advice that are printed."""


def to_json(found: Diagnosis, space: ParameterSpace) -> dict[str, Any]:
    """Everything in it; what is not known is null."""
    explanation, excitation = found.explanation, found.excitation
    told: dict[str, Any] = {
        "rows": found.rows,
        "episodes": found.episodes,
        "runs": found.runs,
        "control_step": found.control_step,
        "fatal": found.fatal,
        "findings": [finding.to_json() for finding in found.findings],
        "channels": [
            {"name": row.name, "kind": row.kind, "unit": row.unit, "low": row.low, "high": row.high, "step": row.step}
            | ({"at_limits": row.at_limits} if row.kind == "action" else {})
            for row in found.channels
        ],
        "explanation": None,
        "parameters": None,
        "pairs": [],
        "control_steps": found.control_steps,
        "seconds": round(found.seconds, 3),
    }
    if explanation is not None:
        signals = [row.name for row in found.channels if row.kind == "signal"]
        rows = {"midrange": 0, "best_draw": explanation.best}
        told["explanation"] = {
            "horizons": list(explanation.horizons),
            **{
                name: {signal: _known(explanation.errors[draw, :, at]) for at, signal in enumerate(signals)}
                | {"overall": _known(explanation.overall[draw])}
                for name, draw in rows.items()
            },
        }
    if excitation is not None:
        told["parameters"] = {
            row.name: {"unit": row.unit, "low": row.low, "high": row.high, "effect": effect, "half_width": width}
            for row, effect, width in zip(
                space.parameters, _known(excitation.effect), _known(excitation.half_width), strict=True
            )
        }
        told["pairs"] = [[first, second, value] for first, second, value in excitation.pairs]
    return told


def tables(found: Diagnosis, space: ParameterSpace) -> tuple[RenderableType, ...]:
    """The log, its channels, what the model explains, what it could tell of each parameter, and the findings."""
    seconds = found.rows * found.control_step
    line = (
        f"{found.rows:,} rows in {found.runs} run{'s' * (found.runs != 1)} ({found.episodes} "
        f"stretch{'es' * (found.episodes != 1)} without a break), {found.control_step:g} s apart: {seconds:,.1f} s"
    )
    parts: list[RenderableType] = [line, _channel_table(found)]
    if found.explanation is not None:
        parts.append(_explanation_table(found))
    if found.excitation is not None:
        parts.append(_parameter_table(found, space))
    return (*parts, *_finding_lines(found))


def _channel_table(found: Diagnosis) -> Table:
    table = _table("channels", "channel", "unit")
    for heading in ("lowest", "highest", "typical change", "at limits"):
        table.add_column(heading, justify="right")
    for row in found.channels:
        limits = f"{100 * row.at_limits:.1f} %" if row.kind == "action" else ""
        table.add_row(row.name, row.unit, f"{row.low:.4g}", f"{row.high:.4g}", f"{row.step:.3g}", limits)
    return table


def _explanation_table(found: Diagnosis) -> Table:
    explanation = found.explanation
    assert explanation is not None
    ahead = ", ".join(map(str, explanation.horizons))
    table = _table(f"prediction errors {ahead} steps ahead, in % of what 'nothing changes' errs", "signal")
    for where in ("mid-range", "best draw"):
        for at, horizon in enumerate(explanation.horizons):
            table.add_column(f"{horizon}" if at else f"{where}: {horizon}", justify="right")
    signals = [row.name for row in found.channels if row.kind == "signal"]
    both = (0, explanation.best)
    for at, name in enumerate(signals):
        table.add_row(name, *(_percent(value) for draw in both for value in explanation.errors[draw, :, at]))
    table.add_row("all", *(_percent(value) for draw in both for value in explanation.overall[draw]))
    return table


def _parameter_table(found: Diagnosis, space: ParameterSpace) -> Table:
    excitation = found.excitation
    assert excitation is not None
    table = _table("what this log could tell of each parameter, at best", "parameter", "unit")
    for heading in ("range", "effect of half of it", "expected 95 %", "of its range"):
        table.add_column(heading, justify="right")
    columns = zip(space.parameters, excitation.effect, excitation.half_width, strict=True)
    for row, effect, width in columns:
        known = math.isfinite(width)
        table.add_row(
            row.name,
            row.unit,
            f"[{row.low:g}, {row.high:g}]",
            f"{effect:.3g} × noise" if known else "?",
            f"± {width:.2g}" if known else "?",
            f"{100 * width / (row.high - row.low):.2g} %" if known else "?",
        )
    return table


def _finding_lines(found: Diagnosis) -> tuple[str, ...]:
    if not found.findings:
        return ("nothing to warn of",)
    counts = [sum(finding.level == level for finding in found.findings) for level in LEVELS]
    names = ("fatal", "warnings", "notes")
    head = ", ".join(f"{count} {name}" for count, name in zip(counts, names, strict=True) if count)
    lines, alike = [head], Counter[tuple[str, str]]()
    for finding in found.findings:
        kind = (finding.level, finding.do)
        alike[kind] += 1
        if alike[kind] <= MOST_ALIKE:
            lines.append(f"{finding.level}: {finding.sentence}")
    hidden = sum(count - MOST_ALIKE for count in alike.values() if count > MOST_ALIKE)
    return (*lines, f"... and {hidden} more like these: --json has all") if hidden else tuple(lines)


def _table(title: str, *texts: str) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    for heading in texts:
        table.add_column(heading, no_wrap=True)
    return table


def _percent(value: float) -> str:
    return "" if not math.isfinite(value) else f"{100 * value:.3g} %"


def _known(values: np.ndarray) -> list[float | None]:
    return [float(value) if math.isfinite(value) else None for value in values]
