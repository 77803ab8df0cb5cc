"""A log and a model compared before any calibration: `check` returns a `Diagnosis`, as JSON or as tables to read."""

import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import jax
import numpy as np
from rich import box
from rich.console import RenderableType
from rich.table import Table

from madoc.data import Dataset, typical_change
from madoc.data.findings import LEVELS, Finding, worst_first
from madoc.diagnosis.channels import Channel, channel_findings, channels_of
from madoc.diagnosis.exchanged_columns import exchanged_columns
from madoc.diagnosis.excitation import Excitation, excitation_findings, excite, excite_unknown
from madoc.diagnosis.explanation import Explanation, action_findings, box_draws, explain, explanation_findings
from madoc.diagnosis.inertial import inertial_findings
from madoc.diagnosis.response import response_findings
from madoc.diagnosis.scales import range_findings, scale_findings, timestep_findings
from madoc.diagnosis.speeds import speed_findings
from madoc.identification.states import LoggedStates, probing_rows, states_of
from madoc.parameters import ParameterSpace
from madoc.robots import Robot
from madoc.simulation import Simulator
from madoc.simulation.base import SIMULATED
from madoc.simulation.response import insensitive

MOST_ALIKE = 4
"""Largest number of findings with the same advice that are printed; `--json` has all."""


@dataclass(frozen=True)
class Diagnosis:
    """A log and a model compared before any calibration.

    Attributes:
        episodes: Number of stretches of rows without a break.
        runs: Number of recordings that these come from.
        control_step: Time between two rows, s.
        explanation: How well the model predicts the log; None where states are not exact.
        excitation: How well the log can determine each parameter; None after a fatal finding.
        findings: The findings, the worst first.
        control_steps: Number of control steps simulated.
        seconds: Wall-clock time.
    """

    rows: int
    episodes: int
    runs: int
    control_step: float
    channels: tuple[Channel, ...]
    explanation: Explanation | None
    excitation: Excitation | None
    findings: tuple[Finding, ...]
    control_steps: int
    seconds: float

    @property
    def fatal(self) -> bool:
        """Whether a calibration would be pointless."""
        return any(finding.level == "fatal" for finding in self.findings)


def check(
    dataset: Dataset, simulator: Simulator, *, robot: Robot | None = None, seed: int = 0, intervals: bool = True
) -> Diagnosis:
    """Compare a log with a model before any calibration; findings of the log's reader are among those returned.

    The spec of a user's own `robot` gives units and reasons. The seed is that of the windows that are replayed and of
    the parameters that are tried. With `intervals` expected ones are as narrow as they can be, which takes as long as
    the rest, and are there where initial states have to be fitted for them; a calibration that follows has its own.
    """
    started = time.monotonic()
    of_rows, of_box, of_actions, of_windows = jax.random.split(jax.random.key(seed), 4)
    channels = channels_of(dataset, simulator.task, robot)
    findings = [*dataset.findings, *channel_findings(dataset, len(simulator.parameters), channels)]
    findings += range_findings(dataset, simulator)
    about_speeds, late_speeds = speed_findings(dataset, simulator)
    findings += [*about_speeds, *(inertial_findings(dataset, robot, simulator.control_step) if robot else [])]
    explanation, excitation, began = None, None, SIMULATED.control_steps
    if not any(finding.level == "fatal" for finding in findings):
        logged = states_of(dataset, simulator)
        idle = insensitive(simulator, *probing_rows(logged, dataset, simulator), key=of_rows)
        what = "it changes nothing that is seen, from one end of its range to the other"
        findings += [Finding("fatal", what, name, "leave it out of the spec, or widen its range") for name in idle]
        of_starts, of_draws = jax.random.split(of_box)
        draws = box_draws(len(simulator.parameters), of_draws)
        start = draws[0]
        responding = response_findings(dataset, simulator, logged, draws, late_speeds=late_speeds)
        findings += responding
        if logged.kind == "exact":
            explanation = explain(dataset, simulator, logged, draws, key=of_starts)
            points, ahead = draws[[0, explanation.best]], explanation.horizons[min(1, len(explanation.horizons) - 1)]
            scale = typical_change(dataset, simulator.task.attitudes)
            exchanged = exchanged_columns(dataset, simulator, points, ahead, scale, contradicts=False)
            findings += [*explanation_findings(explanation, channels, exchanged), *exchanged]
            told = frozenset(finding.where for finding in responding)
            findings += action_findings(dataset, simulator, logged, explanation, told=told, key=of_actions)
            start = explanation.draws[explanation.best]
            excitation = excite(dataset, simulator, logged, start=start, key=of_windows, intervals=intervals)
        else:
            findings.append(_inexact_states_finding(logged, robot))
            excitation = excite_unknown(dataset, simulator, logged, intervals=intervals)
        findings += excitation_findings(excitation, simulator)
        findings += scale_findings(dataset, simulator, logged, start, only_ratios=excitation.only_ratios)
        findings += timestep_findings(dataset, simulator, logged, start)
    return Diagnosis(
        rows=len(dataset),
        episodes=len(dataset.episode_starts),
        runs=len(set(dataset.run_names or ())) or len(dataset.episode_starts),
        control_step=simulator.control_step,
        channels=channels,
        explanation=explanation,
        excitation=excitation,
        findings=worst_first(findings),
        control_steps=SIMULATED.control_steps - began,
        seconds=time.monotonic() - started,
    )


def _inexact_states_finding(logged: LoggedStates, robot: Robot | None) -> Finding:
    reasons = ", ".join(robot.undetermined) if robot is not None and robot.undetermined else logged.reason
    estimated = ""
    if logged.kind == "approximate":
        floor = ", and its base stands on the floor by its attitude" if logged.placed.any() else ""
        estimated = f": least-squares estimates them from what is logged{floor}"
    return Finding(
        "note",
        f"states cannot be rebuilt from the log ({reasons}){estimated}; this check did not compare the model with the "
        "log, and methods that take logged states for true will refuse",
        "signals",
        "" if estimated else "log the position and the velocity of every joint",
    )


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
    table = _table(f"prediction errors {ahead} rows ahead, in % of what 'nothing changes' errs", ("signal",), numbers)
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
