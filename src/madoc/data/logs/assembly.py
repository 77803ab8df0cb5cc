"""From runs to a dataset of a robot: columns are looked up, checked, cut where rows are missing, and scaled."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from madoc.data.dataset import Dataset, close_episodes, join
from madoc.data.findings import Finding
from madoc.data.logs.jumps import of_one_sign, unwrapped
from madoc.data.logs.tables import Run, Table, as_numbers
from madoc.data.logs.timing import (
    Resample,
    Series,
    averaged,
    check_ascending,
    common_grid,
    held_finding,
    on_grid,
    rate_findings,
    steady_links,
)
from madoc.data.validation import ACTION_TOLERANCE
from madoc.errors import MadocError, nearest_hint
from madoc.robots import Robot
from madoc.robots.drive_spec import ConditionSpec
from madoc.robots.spec import LogSpec
from madoc.types import Transitions

DEFAULT_TIME = "time"
_MOST_LOST = 0.5
"""Share of a run's rows that may be unusable, from 0 to 1; a run that loses more is refused."""
LARGEST = 1e30
"""Largest reading, in any unit, that a sensor can have meant."""
_BROKEN = f"NaN, infinity, more than {LARGEST:.0e} or nothing in a signal or action"


@dataclass(frozen=True)
class Steps:
    """The rows of a run on the robot's control steps, with actions in their units, and the names of rows in errors.

    They are `linked` where the next row follows one control step later and both can be used.
    """

    observation: Float[np.ndarray, "rows signals"]
    action: Float[np.ndarray, "rows actions"]
    linked: Bool[np.ndarray, " links"]
    place: Callable[[int], str]
    findings: Sequence[Finding]


def wanted_columns(robot: Robot) -> dict[str, str]:
    """The log's column of each signal and action."""
    names = [*(signal.name for signal in robot.signals), *(action.name for action in robot.actions)]
    return {name: robot.spec.log.columns.get(name, name) for name in names}


def assemble(runs: Sequence[Run], robot: Robot, *, origin: str, clip_actions: bool = False) -> Dataset:
    """A dataset of all runs; every stretch without a break is an episode, named after its run.

    Row k holds an observation and the action taken until row k + 1; the last action of a stretch is not used.
    """
    if not runs:
        raise MadocError(f"expected at least one episode in {origin}, got none; record it again")
    return join(
        [_episodes(_with_conditions(run, robot), robot, origin, clip_actions=clip_actions) for run in runs], origin
    )


def _with_conditions(run: Run, robot: Robot) -> Run:
    """A run with a column for each condition that its file's name tells; a value not in the spec is refused."""
    tables = run.tables
    for condition in robot.spec.conditions:
        if condition.file_name is None:
            _check_condition(run, condition, robot.spec.log.columns.get(condition.name, condition.name))
            continue
        value = condition.value_in(run.name)
        if value not in condition.values:
            got = (
                "no number there; name the file so"
                if value is None
                else f"{value:g}; add it to values: in the spec, or name the file with a decimal point"
            )
            raise MadocError(
                f"expected {condition.name} in the file name {run.name}, as {condition.file_name}, to be one of "
                f"{', '.join(f'{one:g}' for one in condition.values)}, got {got}"
            )
        tables = tuple(
            replace(table, columns={**table.columns, condition.name: np.full(len(table), value)}) for table in tables
        )
    return replace(run, tables=tables)


def _check_condition(run: Run, condition: ConditionSpec, column: str) -> None:
    """Refuse a run whose column of a condition has another value than the spec's, or more than one."""
    for table in run.tables:
        if column not in table.columns or table.columns[column].dtype.kind not in "fiu":
            continue
        values = np.unique(table.columns[column])
        found = values[np.isfinite(values)]
        if len(found) > 1:
            raise MadocError(
                f"expected one value of {condition.name} throughout {run.name}, got {found[0]:g} and {found[1]:g}; "
                "split the run where it changes"
            )
        if len(found) and not np.isclose(found[0], condition.values, rtol=1e-6).any():
            raise MadocError(
                f"expected {condition.name} in {run.name} to be one of "
                f"{', '.join(f'{one:g}' for one in condition.values)}, got {found[0]:g}; add it to values: in the spec"
            )


def _episodes(run: Run, robot: Robot, origin: str, *, clip_actions: bool) -> Dataset:
    """The dataset of one run."""
    steps = _steps(run, robot)
    used = np.flatnonzero(steps.linked)
    if not len(used):
        raise MadocError(
            f"expected two rows in a row in {run.name}, a control step apart and all numbers, got none; leave the "
            "file out"
        )
    scaled, clipped = _scaled(steps, used, robot, run.name, clip_actions=clip_actions)
    transitions = Transitions(
        observation=steps.observation[used],
        action=scaled,
        reward=np.zeros(len(used)),
        next_observation=steps.observation[used + 1],
        terminated=np.zeros(len(used), dtype=bool),
        truncated=np.zeros(len(used), dtype=bool),
    )
    starts = np.flatnonzero(np.append(True, np.diff(used) > 1))
    return Dataset(
        close_episodes(transitions, starts),
        starts,
        robot.task.name,
        robot.task.physics,
        origin,
        run_names=(run.name,) * len(starts),
        findings=(*steps.findings, *clipped),
    )


def _steps(run: Run, robot: Robot) -> Steps:
    """The columns of a run on the robot's control steps."""
    layout, control_step = robot.spec.log, robot.spec.control_step
    wanted = wanted_columns(robot)
    tables = {name: _table_of(run, name, column) for name, column in wanted.items()}
    if layout.resample is not None:
        return _resampled(run, robot, wanted, tables, layout.resample)
    first = next(iter(wanted))
    for name, table in tables.items():
        if table is not tables[first]:
            raise MadocError(
                f"columns {wanted[first]!r} and {wanted[name]!r} of {run.name} were not logged together, row by row "
                f"({len(tables[first]):,} and {len(table):,} rows); if each has times of its own, ask for "
                "log: resample: hold or linear"
            )
    series, findings = _series(run, tables[first], list(wanted.values()), robot)
    if run.timed:
        linked, unsteady = steady_links(series, control_step, layout.tolerance)
        findings += [*unsteady, *rate_findings(series, control_step)]
    else:
        linked = np.ones(len(series.time) - 1, dtype=bool)
        what = f"its format keeps no times: rows are taken to be {control_step:g} s apart"
        findings.append(Finding("note", what, run.name))
    observation, action = np.split(series.values, [len(robot.signals)], axis=1)
    seen, acted = np.isfinite(observation).all(-1), np.isfinite(action).all(-1)
    broken = ~(seen & acted)
    broken[-1] = ~seen[-1]  # the last action of a run is not used
    findings += _lost(series, broken, _BROKEN, "the run is cut there")
    return Steps(observation, action, linked & seen[:-1] & acted[:-1] & seen[1:], series.place, findings)


def _table_of(run: Run, name: str, column: str) -> Table:
    """The table that a signal's or action's column is in."""
    for table in run.tables:
        if column in table.columns:
            return table
    raise _no_column(run, name, column)


def _no_column(run: Run, name: str, column: str) -> MadocError:
    called = f"{column!r}" if column == name else f"{column!r} (which log: columns: names for {name})"
    for table in run.tables:
        if column in table.others:
            return MadocError(f"expected numbers in column {called} of {run.name}, got {table.others[column]}")
    return MadocError(
        f"no column {called} in {run.name}; {nearest_hint(column, run.names)}; name it under log: columns: in the spec"
    )


def _time(run: Run, table: Table, layout: LogSpec) -> tuple[Float[np.ndarray, " rows"], str]:
    """Times of a table's rows, and the name of their column."""
    if not run.timed:
        return np.arange(len(table), dtype=np.float64), ""
    name = layout.time
    if name not in table.columns and name == DEFAULT_TIME and table.clock is not None:
        name = table.clock
    if name not in table.columns:
        if name in run.names:  # of another table
            raise MadocError(f"column {name!r} of {run.name} has another number of rows than the columns it times")
        raise MadocError(str(_no_column(run, "time", name)).replace("log: columns:", "log: time:"))
    return as_numbers(table, name, run.name), name


def _series(run: Run, table: Table, columns: Sequence[str], robot: Robot) -> tuple[Series, list[Finding]]:
    """Columns of one table with their times, which ascend, and angles that do not wrap around."""
    if len(table) < 2:
        raise MadocError(f"expected at least two rows in {run.name}, got {len(table)}; leave the file out")
    time, clock = _time(run, table, robot.spec.log)
    values = np.stack([as_numbers(table, column, run.name) for column in columns], axis=-1)
    series, timed = Series(time, values, table, np.arange(len(time)), run.name), np.isfinite(time)
    findings = _lost(series, ~timed, f"no finite time in column {clock!r}", "left out")
    series = series.take(timed)
    check_ascending(series)
    names = wanted_columns(robot)
    turns = {names[signal.name]: signal.turn for signal in robot.signals}
    series = replace(series, values=np.where(np.abs(series.values) > LARGEST, np.nan, series.values))
    values, wraps = unwrapped(series, columns, turns)
    series = replace(series, values=values)
    values, signs = of_one_sign(series, columns, {names[each.name]: each.quaternion for each in robot.signals})
    for drive in (action.drive for action in robot.spec.actions if action.drive is not None):
        column = names.get(drive.supply_from or "", "")
        if drive.supply_average is not None and column in columns:
            rows_a_second = 1.0 if run.timed else 1.0 / robot.spec.control_step
            at = columns.index(column)
            values[:, at] = averaged(series.time, values[:, at], drive.supply_average * rows_a_second)
    return replace(series, values=values), [*findings, *wraps, *signs]


def _lost(series: Series, lost: Bool[np.ndarray, " rows"], what: str, consequence: str) -> list[Finding]:
    """A warning about rows that cannot be used, if there are any; more than half of a run's rows are refused."""
    count, rows = int(lost.sum()), len(lost)
    if not count:
        return []
    first = series.place(int(lost.argmax()))
    if count > _MOST_LOST * rows:
        raise MadocError(
            f"expected numbers in {series.run}, got {what} in {count:,} of {rows:,} rows, the first {first}; record it "
            "again or name other columns"
        )
    sentence = f"{count} of {rows:,} rows have {what}, the first {first}: {consequence}"
    return [Finding("warning", sentence, series.run, "look at the recorder")]


def _resampled(run: Run, robot: Robot, wanted: Mapping[str, str], tables: Mapping[str, Table], how: Resample) -> Steps:
    """A run on control steps: signals held or interpolated, actions always held, as a command holds until the next."""
    if not run.timed:
        raise MadocError(f"{run.name} keeps no times, so it cannot be resampled; leave log: resample: out")
    control_step = robot.spec.control_step
    findings: list[Finding] = []
    pieces: list[tuple[Series, list[str], bool]] = []
    for table in run.tables:
        for channels in (robot.signals, robot.actions):
            names = [channel.name for channel in channels if tables[channel.name] is table]
            if not names:
                continue
            series, untimed = _series(run, table, [wanted[name] for name in names], robot)
            whole = np.isfinite(series.values).all(-1)
            findings += [*untimed, *_lost(series, ~whole, _BROKEN, "left out before resampling")]
            pieces.append((series.take(whole), names, channels is robot.actions))
    sensed, acted = ([series for series, _, acting in pieces if acting is kind] for kind in (False, True))
    grid = common_grid(sensed, acted, control_step)
    findings += [finding for series in acted for finding in held_finding(series, grid[-1])]
    kept = np.ones(len(grid), dtype=bool)
    columns: dict[str, np.ndarray] = {}
    for series, names, acting in pieces:
        values, outside_gaps = on_grid(series, grid, "hold" if acting else how)
        columns.update(zip(names, values.T, strict=True))
        kept &= outside_gaps | acting  # commands may be logged only where they change
    if not kept.all():
        what = f"{(~kept).sum()} of {len(grid):,} control steps fall into gaps: the run is cut there"
        findings.append(Finding("warning", what, run.name))
    rates = sorted(
        {round(float(np.median(np.diff(series.time))), 9) for series, _, _ in pieces if len(series.time) > 1}
    )
    faster = bool(rates) and rates[0] < 0.6 * control_step
    what = (
        f"rows {' and '.join(f'{rate:.4g}' for rate in rates)} s apart (median) were brought to {control_step:g} "
        f"s: signals {'interpolated' if how == 'linear' else 'held'}, actions held"
    )
    do = "actions between two control steps are lost; a smaller control_step keeps them" if faster else ""
    findings.append(Finding("note", what, run.name, do))
    observation, action = (
        np.stack([columns[channel.name] for channel in channels], axis=-1)
        for channels in (robot.signals, robot.actions)
    )
    return Steps(observation, action, kept[:-1] & kept[1:], "control step {}".format, tuple(dict.fromkeys(findings)))


def _scaled(
    steps: Steps, used: np.ndarray, robot: Robot, run: str, *, clip_actions: bool
) -> tuple[Float[np.ndarray, "rows actions"], list[Finding]]:
    """Actions of the used rows, scaled to [-1, 1] by the ranges of their channels, and clipped if asked for.

    Where any are clipped, warnings say how many.
    """
    low = np.array([channel.low for channel in robot.actions])
    high = np.array([channel.high for channel in robot.actions])
    action = steps.action[used]
    scaled = 2.0 * (action - low) / (high - low) - 1.0
    outside = np.abs(scaled) > 1.0 + ACTION_TOLERANCE
    if outside.any() and not clip_actions:
        row, column = (int(index) for index in np.argwhere(outside)[0])
        channel = robot.actions[column]
        smallest, largest = action[:, column].min(), action[:, column].max()
        span = f"[{channel.low:g}, {channel.high:g}] {channel.unit}".rstrip()
        raise MadocError(
            f"expected {channel.name} within its range of {span}, got "
            f"{action[row, column]:.6g} in {steps.place(int(used[row]))} of {run} ({int(outside[:, column].sum())} "
            f"such rows; the log has {smallest:.4g} to {largest:.4g}); is the unit right? Else widen low and high in "
            "the spec, or pass --clip-actions where the motor driver clips as well"
        )
    clipped = [
        Finding("warning", f"{count:,} of {len(action):,} values of {channel.name} were clipped to its range", run)
        for channel, count in zip(robot.actions, outside.sum(0), strict=True)
        if count
    ]
    return np.clip(scaled, -1.0, 1.0), clipped
