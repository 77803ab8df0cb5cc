"""Time in a log: whether rows are a control step apart, where it has gaps, and resampling where it is asked for."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.data.findings import Finding
from madoc.data.logs.tables import Table
from madoc.errors import MadocError

Resample = Literal["hold", "linear"]

GAP = 3.0
"""Time between two rows of a resampled log, in median time steps; a longer one is a gap."""
OFF_RATE, FAR_OFF_RATE = 0.01, 0.02
"""Difference of the mean time step from the control step, as a share of it. From the first on a log is warned of, from
the second on it is refused: lengths and gravity, which go with the square of time, would be 4 % wrong."""
UNSTEADY = 0.05
"""Standard deviation of time steps as a share of the control step; a larger one is noted."""
DRIFT = 0.01
"""Change of the time step from the first to the last row, as a share of the control step; a larger one is warned of."""
_CERTAIN = 5.0
"""Standard errors by which a mean or a slope has to differ before it is told."""
MOST_FILLED = 10
"""Largest number of control steps that are made of a row by resampling."""
_SKIPPED = 1.5
"""Time between two rows in median time steps; a longer one has lost rows in it, and says nothing of the rate."""
_FACTORS = {1e3: "ms", 1e6: "µs", 1e9: "ns"}
_ROUNDING = 1e-6
"""Difference of two times as a share of a control step; with a smaller one they count as equal."""


@dataclass(frozen=True)
class Series:
    """Columns of one table of a run, by its name: time in s, signals and actions, and the place of each row there."""

    time: Float[np.ndarray, " rows"]
    values: Float[np.ndarray, "rows columns"]
    table: Table
    rows: Int[np.ndarray, " rows"]
    run: str

    def take(self, kept: Bool[np.ndarray, " rows"]) -> "Series":
        """Only the rows that are kept."""
        return replace(self, time=self.time[kept], values=self.values[kept], rows=self.rows[kept])

    def place(self, row: int) -> str:
        """The name of a row in an error."""
        return self.table.place(int(self.rows[row]))


def check_ascending(series: Series) -> None:
    """Refuse time that stands still or goes back; the sentence names the first such place."""
    back = np.flatnonzero(np.diff(series.time) <= 0)
    if not len(back):
        return
    before, after = series.time[back[0]], series.time[back[0] + 1]
    if before == after:
        what, remedy = f"the time {after:.9g} twice", "keep one of the rows"
    else:
        what = f"{after:.9g} after {before:.9g}"
        remedy = "sort the rows, or write each run to a file of its own"
    raise MadocError(
        f"expected time to go forward in {series.run}, got {what} in {series.place(int(back[0]) + 1)} "
        f"({len(back)} such rows); {remedy}"
    )


def steady_links(
    series: Series, control_step: float, tolerance: float
) -> tuple[Bool[np.ndarray, " links"], list[Finding]]:
    """Whether each row is one control step after the row before it, and a warning where it is not.

    Where most rows are not, the log has another rate, or its time another unit, and is refused.
    """
    steps = np.diff(series.time)
    steady = np.abs(steps - control_step) <= tolerance * control_step + _ROUNDING * control_step
    if len(steps) and steady.mean() < 0.5:
        raise _wrong_rate(series, control_step, tolerance)
    odd = np.flatnonzero(~steady)
    if not len(odd):
        return steady, []
    at = int(odd[np.argmax(np.abs(steps[odd] - control_step))])
    finding = Finding(
        "warning",
        f"{len(odd)} of {len(steps):,} time steps are more than {100 * tolerance:g} % off the control step of "
        f"{control_step:g} s, the farthest {steps[at]:.4g} s before {series.place(at + 1)}: the run is cut there",
        series.run,
        "nothing if the recorder paused; for a recorder whose clock jitters raise log: tolerance, or ask for "
        "log: resample",
    )
    return steady, [finding]


def rate_findings(series: Series, control_step: float) -> list[Finding]:
    """Findings on the rate at which rows were logged: its mean, its change over the run, and its scatter.

    Steps in which rows were lost are left out. A clock that runs evenly but wrongly cannot be seen here.

    Raises:
        MadocError: Rows are on average so far from a control step apart that every estimate would be wrong.
    """
    from scipy.stats import linregress  # slow to import, and a suite's plan only looks for logs

    steps = np.diff(series.time)
    kept = np.flatnonzero(steps < _SKIPPED * np.median(steps))
    if len(kept) < 10:
        return []
    steps = steps[kept] / control_step
    mean, deviation = float(steps.mean()), float(steps.std())
    certain = _CERTAIN * deviation / np.sqrt(len(steps)) + _ROUNDING
    line = linregress(kept, steps)
    change = float(line.slope * (kept[-1] - kept[0]))
    findings, drift = [], ""
    if abs(change) > max(DRIFT, _CERTAIN * line.stderr * (kept[-1] - kept[0])):
        begin, end = (control_step * (mean + side * change / 2.0) for side in (-1.0, 1.0))
        drift = f"{begin:.4g} s apart at the beginning of the run and {end:.4g} s at its end"
        remedy = "look at the recorder's clock, or ask for log: resample: linear"
        findings.append(Finding("warning", f"the time between rows drifts: {drift}", series.run, remedy))
    if abs(mean - 1.0) > max(OFF_RATE, certain):
        findings.append(_off_rate(series, control_step, mean, drift))
    if deviation > UNSTEADY:
        what = f"time steps scatter by {100 * deviation:.2g} % of the control step (standard deviation)"
        remedy = "nothing if only the time stamps are late; if rows were taken then, ask for log: resample: linear"
        findings.append(Finding("note", what, series.run, remedy))
    return findings


def _off_rate(series: Series, control_step: float, ratio: float, drift: str) -> Finding:
    """A warning that rows are on average `ratio` control steps apart; a ratio far from 1 is refused."""
    more = f"{abs(100 * (ratio - 1.0)):.2g} % {'more' if ratio > 1.0 else 'less'}"
    spacing, remedy = control_step * ratio, "set control_step to that, or ask for log: resample: linear"
    if abs(ratio - 1.0) > FAR_OFF_RATE:
        raise MadocError(
            f"expected rows {control_step:g} s apart in {series.run}, as control_step says, got {spacing:.4g} s on "
            f"average, {more}{drift and f' ({drift})'}: speeds and accelerations would all be wrong; {remedy}"
        )
    what = f"rows are {spacing:.5g} s apart on average, {more} than the control step of {control_step:g} s"
    return Finding("warning", what, series.run, remedy)


def _require_seconds(series: Series, control_step: float) -> None:
    """Refuse time in another unit, where rows are as many of its units apart as a control step has."""
    usual = float(np.median(np.diff(series.time)))
    for factor, unit in _FACTORS.items():
        if abs(usual / control_step / factor - 1.0) < 0.3:
            raise MadocError(
                f"expected time in s in {series.run}, got steps of {usual:g} where the control step is "
                f"{control_step:g} s; is it in {unit}? divide it by {factor:g}"
            )


def _wrong_rate(series: Series, control_step: float, tolerance: float) -> MadocError:
    _require_seconds(series, control_step)
    steps = np.diff(series.time)
    usual, mean = float(np.median(steps)), float(np.mean(steps))
    if min(abs(usual / control_step - 1.0), abs(mean / control_step - 1.0)) <= tolerance:
        return MadocError(
            f"most time steps of {series.run} are more than {100 * tolerance:g} % off the control step of "
            f"{control_step:g} s, though they are {mean:.4g} s on average; raise log: tolerance, or ask for log: "
            "resample: hold or linear"
        )
    return MadocError(
        f"expected rows {control_step:g} s apart in {series.run}, as control_step says, got {usual:.6g} s (median); "
        "set control_step to that, or ask for log: resample: hold or linear"
    )


def common_grid(
    signals: Sequence[Series], actions: Sequence[Series], control_step: float
) -> Float[np.ndarray, " grid"]:
    """Times a control step apart, while all signals have rows, from when all actions have begun.

    An action holds after its last row, as commands may be logged only where they change.

    Raises:
        MadocError: That is shorter than a control step, or rows are so far apart that time must be in another unit.
    """
    for part in signals:
        if len(part.time) > 1:
            _require_seconds(part, control_step)
    start, end = max(part.time[0] for part in (*signals, *actions)), min(part.time[-1] for part in signals)
    count = int(np.floor((end - start) / control_step + _ROUNDING)) + 1
    if count < 2:
        raise MadocError(
            f"expected all columns of {signals[0].run} to be logged at the same time for at least {control_step:g} s, "
            f"got {max(0.0, end - start):.4g} s; record them together"
        )
    rows = max(len(part.time) for part in signals)
    if count > MOST_FILLED * rows:
        raise MadocError(
            f"expected rows about {control_step:g} s apart in {signals[0].run}, got {rows:,} rows in "
            f"{end - start:g} s, which resampling would make {count:,}; is time in s? Else set control_step to what "
            "was logged"
        )
    return start + control_step * np.arange(count)


def held_finding(actions: Series, end: float) -> list[Finding]:
    """A warning where actions were last logged long before the last time of the signals."""
    if len(actions.time) < 2:
        return []
    usual, left = float(np.median(np.diff(actions.time))), float(end - actions.time[-1])
    if left <= GAP * usual:
        return []
    what = f"its last action is {left:.3g} s before its last signal, and is held until then"
    return [Finding("warning", what, actions.run, "nothing if actions are logged only where they change")]


def averaged(
    time: Float[np.ndarray, " rows"], values: Float[np.ndarray, " rows"], width: float
) -> Float[np.ndarray, " rows"]:
    """Each value as the mean of those at most half a width before or after it; what is not finite stays as it is."""
    known = np.isfinite(values)
    first = np.searchsorted(time, time - width / 2, side="left")
    last = np.searchsorted(time, time + width / 2, side="right")
    sums, counts = (np.append(0.0, np.cumsum(each)) for each in (np.where(known, values, 0.0), known))
    means = (sums[last] - sums[first]) / np.maximum(counts[last] - counts[first], 1.0)
    return np.where(known, means, values)


def on_grid(
    series: Series, grid: Float[np.ndarray, " grid"], how: Resample
) -> tuple[Float[np.ndarray, "grid columns"], Bool[np.ndarray, " grid"]]:
    """Values at the times of a grid, and whether each time lies outside all gaps.

    `hold` takes the last row before a time, `linear` interpolates between two rows.
    """
    steps, equal = np.diff(series.time), _ROUNDING * (grid[1] - grid[0])
    before = np.searchsorted(series.time, grid + equal, side="right") - 1
    before = np.clip(before, 0, len(series.time) - 1)
    if how == "hold":
        values = series.values[before]
    else:
        values = np.stack([np.interp(grid, series.time, column) for column in series.values.T], axis=-1)
    usual = max(float(np.median(steps)), grid[1] - grid[0]) if len(steps) else np.inf
    in_gap = np.append(steps > GAP * usual, False)[before]
    return values, ~in_gap | (np.abs(series.time[before] - grid) < equal)
