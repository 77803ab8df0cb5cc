"""From runs to a dataset of a robot: columns are found, checked and cut where they break, actions scaled to [-1, 1]."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from madoc.data.dataset import Dataset, close_episodes
from madoc.data.findings import Finding
from madoc.data.logs.tables import Run, Table, as_numbers
from madoc.data.logs.timing import Series, check_ascending, common_grid, on_grid, steady_links
from madoc.data.validation import ACTION_TOLERANCE
from madoc.errors import MadocError, nearest_hint
from madoc.robots import Robot
from madoc.robots.spec import LogSpec
from madoc.types import Transitions

DEFAULT_TIME = "time"
_MOST_LOST = 0.5
"""Largest share of a run's rows that may be unusable; a run that loses more is refused."""
_BROKEN = "NaN, infinity or nothing in a signal or action"


@dataclass(frozen=True)
class Stretches:
    """The signals and actions of a run, a control step apart.

    Attributes:
        observation: Signals by row.
        action: Actions by row, in their units.
        linked: Whether the next row follows a control step later.
        series: The rows of the log, to name them in errors; None where they were resampled.
        findings: Notes and warnings.
    """

    observation: Float[np.ndarray, "rows signals"]
    action: Float[np.ndarray, "rows actions"]
    linked: Bool[np.ndarray, " links"]
    series: Series | None
    findings: tuple[Finding, ...]


def wanted_columns(robot: Robot) -> dict[str, str]:
    """The log's column of each signal and action."""
    names = [*(signal.name for signal in robot.signals), *(action.name for action in robot.actions)]
    return {name: robot.spec.log.columns.get(name, name) for name in names}


def assemble(runs: Sequence[Run], robot: Robot, *, origin: str, clip_actions: bool = False) -> Dataset:
    """A dataset of all runs; every stretch without a break is an episode, named after its run.

    Row k holds an observation and the action taken until row k + 1; the last action of a stretch is not used.

    Raises:
        MadocError: A column is missing or not numbers, time is not as the spec says, too many rows are broken, actions
            leave their range, or nothing is left.
    """
    observations, actions, following, starts, names = [], [], [], [], []
    findings: list[Finding] = []
    rows = 0
    for run in runs:
        part = stretches(run, robot)
        findings += part.findings
        used = np.flatnonzero(part.linked)
        if not len(used):
            raise MadocError(
                f"expected two rows in a row in {run.name}, a control step apart and all numbers, got none; leave the "
                "file out"
            )
        observations.append(part.observation[used])
        following.append(part.observation[used + 1])
        actions.append(_to_unit(part, used, robot, run.name, clip_actions=clip_actions))
        begins = np.flatnonzero(np.append(True, np.diff(used) > 1))
        starts.append(rows + begins)
        names += [run.name] * len(begins)
        rows += len(used)
    episode_starts = np.concatenate(starts)
    transitions = Transitions(
        observation=np.concatenate(observations),
        action=np.concatenate(actions),
        reward=np.zeros(rows),
        next_observation=np.concatenate(following),
        terminated=np.zeros(rows, dtype=bool),
        truncated=np.zeros(rows, dtype=bool),
    )
    return Dataset(
        close_episodes(transitions, episode_starts),
        episode_starts,
        robot.task.name,
        robot.task.physics,
        origin,
        run_names=tuple(names),
        findings=tuple(findings),
    )


def stretches(run: Run, robot: Robot) -> Stretches:
    """The columns of a run on the robot's control steps.

    Raises:
        MadocError: As `assemble`.
    """
    layout, control_step = robot.spec.log, robot.spec.control_step
    wanted = wanted_columns(robot)
    homes = _homes(run, wanted, layout)
    tables = list(dict.fromkeys(homes.values()))
    if len(tables) > 1 and layout.resample is None:
        raise _several_tables(run, wanted, homes)
    if layout.resample is not None:
        return _resampled(run, robot, wanted, homes)
    series, findings = _series(run, run.tables[tables[0]], list(wanted.values()), layout)
    if run.timed:
        check_ascending(series)
        linked, odd = steady_links(series, control_step, layout.tolerance)
        findings += odd
    else:
        linked = np.ones(max(0, len(series.time) - 1), dtype=bool)
        what = f"its format keeps no times: rows are taken to be {control_step:g} s apart"
        findings.append(Finding("note", what, run.name))
    width = len(robot.signals)
    observation, action = series.values[:, :width], series.values[:, width:]
    whole, lost = _whole(series, observation, action)
    return Stretches(observation, action, linked & whole, series, (*findings, *lost))


def _homes(run: Run, wanted: Mapping[str, str], layout: LogSpec) -> dict[str, int]:
    """The table of each wanted column."""
    homes: dict[str, int] = {}
    for name, column in wanted.items():
        home = next((index for index, table in enumerate(run.tables) if column in table.columns), None)
        if home is None:
            raise _no_column(run, name, column)
        homes[name] = home
    return homes


def _no_column(run: Run, name: str, column: str) -> MadocError:
    called = f"{column!r}" if column == name else f"{column!r} (which log: columns: names for {name})"
    for table in run.tables:
        if column in table.others:
            return MadocError(f"expected numbers in column {called} of {run.name}, got {table.others[column]}")
    return MadocError(
        f"no column {called} in {run.name}; {nearest_hint(column, run.names)}; name it under log: columns: in the spec"
    )


def _several_tables(run: Run, wanted: Mapping[str, str], homes: Mapping[str, int]) -> MadocError:
    first, *_ = wanted
    other = next(name for name in wanted if homes[name] != homes[first])
    lengths = [len(run.tables[homes[name]]) for name in (first, other)]
    return MadocError(
        f"columns {wanted[first]!r} and {wanted[other]!r} of {run.name} were not logged together, row by row "
        f"({lengths[0]:,} and {lengths[1]:,} rows); if each has times of its own, ask for log: resample: hold or linear"
    )


def _time(run: Run, table: Table, layout: LogSpec) -> tuple[Float[np.ndarray, " rows"], str]:
    """Times of a table's rows, and the name of their column."""
    if not run.timed:
        return np.arange(len(table), dtype=np.float64), ""
    name = layout.time
    if name not in table.columns and name == DEFAULT_TIME and table.clock is not None:
        name = table.clock
    if name not in table.columns:
        error = _no_column(run, "time", name)
        if name in run.names:  # of another table
            error = MadocError(f"column {name!r} of {run.name} has another number of rows than the columns it times")
        raise MadocError(str(error).replace("log: columns:", "log: time:"))
    return as_numbers(table, name, run.name), name


def _series(run: Run, table: Table, columns: Sequence[str], layout: LogSpec) -> tuple[Series, list[Finding]]:
    """Columns of one table with their times."""
    if len(table) < 2:
        raise MadocError(f"expected at least two rows in {run.name}, got {len(table)}; leave the file out")
    time, clock = _time(run, table, layout)
    values = np.stack([as_numbers(table, column, run.name) for column in columns], axis=-1)
    known = np.isfinite(time)
    rows = np.flatnonzero(known)
    findings = []
    if len(rows) < len(time):
        first = table.place(int(np.flatnonzero(~known)[0]))
        what = f"no finite time in column {clock!r}"
        findings = [_lost(run.name, len(time) - len(rows), len(time), what, first, "left out")]
    return Series(time[rows], values[rows], table, rows, run.name), findings


def _lost(run: str, broken: int, rows: int, what: str, first: str, consequence: str) -> Finding:
    """A warning about rows that cannot be used.

    Raises:
        MadocError: They are more than half of the rows.
    """
    if broken > _MOST_LOST * rows:
        raise MadocError(
            f"expected numbers in {run}, got {what} in {broken:,} of {rows:,} rows, the first {first}; record it again "
            "or name other columns"
        )
    sentence = f"{broken} of {rows:,} rows have {what}, the first {first}: {consequence}"
    return Finding("warning", sentence, run, "look at the recorder")


def _whole(
    series: Series, observation: Float[np.ndarray, "rows signals"], action: Float[np.ndarray, "rows actions"]
) -> tuple[Bool[np.ndarray, " links"], list[Finding]]:
    """Whether a row has only numbers and is followed by signals that are numbers; and a warning about the others."""
    seen, done = np.isfinite(observation).all(-1), np.isfinite(action).all(-1)
    broken = np.flatnonzero(~(seen & done))
    links = seen[:-1] & done[:-1] & seen[1:]
    # The last row of a run may lack its action, which is not used.
    if not len(broken) or (len(broken) == 1 and broken[0] == len(seen) - 1 and seen[-1]):
        return links, []
    first = series.place(int(broken[0]))
    return links, [_lost(series.run, len(broken), len(seen), _BROKEN, first, "the run is cut there")]


def _resampled(run: Run, robot: Robot, wanted: Mapping[str, str], homes: Mapping[str, int]) -> Stretches:
    """A run on control steps: signals held or interpolated, actions always held, as a command holds until the next."""
    layout, control_step = robot.spec.log, robot.spec.control_step
    if not run.timed:
        raise MadocError(f"{run.name} keeps no times, so it cannot be resampled; leave log: resample: out")
    findings: list[Finding] = []
    pieces: list[tuple[Series, list[str], bool]] = []
    for home in dict.fromkeys(homes.values()):
        for channels, acting in ((robot.signals, False), (robot.actions, True)):
            names = [channel.name for channel in channels if homes[channel.name] == home]
            if not names:
                continue
            series, untimed = _series(run, run.tables[home], [wanted[name] for name in names], layout)
            check_ascending(series)
            series, lost = _without_broken(series)
            pieces.append((series, names, acting))
            findings += [*untimed, *lost]
    grid = common_grid([series for series, _, _ in pieces], control_step)
    kept = np.ones(len(grid), dtype=bool)
    columns: dict[str, np.ndarray] = {}
    for series, names, acting in pieces:
        values, sound = on_grid(series, grid, "hold" if acting else layout.resample or "hold")
        columns.update(zip(names, values.T, strict=True))
        # Commands may be logged only where they change.
        kept &= sound | acting
    if not kept.all():
        count = int((~kept).sum())
        findings.append(
            Finding("warning", f"{count} of {len(grid):,} control steps fall into gaps: the run is cut there", run.name)
        )
    rates = sorted(
        {round(float(np.median(np.diff(series.time))), 9) for series, _, _ in pieces if len(series.time) > 1}
    )
    findings.append(
        Finding(
            "note",
            f"rows {' and '.join(f'{rate:.4g}' for rate in rates)} s apart (median) were brought to {control_step:g} "
            f"s: signals {'interpolated' if layout.resample == 'linear' else 'held'}, actions held",
            run.name,
            "actions between two control steps are lost; a smaller control_step keeps them"
            if rates and rates[0] < 0.6 * control_step
            else "",
        )
    )
    observation = np.stack([columns[channel.name] for channel in robot.signals], axis=-1)
    action = np.stack([columns[channel.name] for channel in robot.actions], axis=-1)
    return Stretches(observation, action, kept[:-1] & kept[1:], None, tuple(dict.fromkeys(findings)))


def _without_broken(series: Series) -> tuple[Series, list[Finding]]:
    """The rows that have only numbers, and a warning about the others, where the series then has a gap."""
    whole = np.isfinite(series.values).all(-1)
    broken = np.flatnonzero(~whole)
    if not len(broken):
        return series, []
    first = series.place(int(broken[0]))
    lost = _lost(series.run, len(broken), len(whole), _BROKEN, first, "left out before resampling")
    return Series(series.time[whole], series.values[whole], series.table, series.rows[whole], series.run), [lost]


def _to_unit(
    part: Stretches, used: np.ndarray, robot: Robot, run: str, *, clip_actions: bool
) -> Float[np.ndarray, "rows actions"]:
    """Actions scaled to [-1, 1] by the ranges of their channels.

    Raises:
        MadocError: One is outside, and clipping was not asked for.
    """
    low = np.array([channel.low for channel in robot.actions])
    high = np.array([channel.high for channel in robot.actions])
    action = part.action[used]
    unit = 2.0 * (action - low) / (high - low) - 1.0
    outside = np.abs(unit) > 1.0 + ACTION_TOLERANCE
    if outside.any() and not clip_actions:
        row, column = (int(index) for index in np.argwhere(outside)[0])
        channel = robot.actions[column]
        place = f"control step {used[row]}" if part.series is None else part.series.place(int(used[row]))
        smallest, largest = action[:, column].min(), action[:, column].max()
        raise MadocError(
            f"expected {channel.name} within its range of [{channel.low:g}, {channel.high:g}] {channel.unit}, got "
            f"{action[row, column]:.6g} in {place} of {run} ({int(outside[:, column].sum())} such rows; the log has "
            f"{smallest:.4g} to {largest:.4g}); is the unit right? Else widen low and high in the spec, or pass "
            "--clip-actions where the motor driver clips as well"
        )
    return np.clip(unit, -1.0, 1.0)
