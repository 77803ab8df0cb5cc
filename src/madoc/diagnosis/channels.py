"""Channels of a log: which of them never move, are at a limit, or are read in coarse steps."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from madoc.data import Dataset
from madoc.data.findings import Finding, Level
from madoc.errors import MadocError
from madoc.identification.noise import resolution_of
from madoc.robots import Robot
from madoc.tasks import Task

AT_LIMIT = 1.0 - 1e-6
"""Absolute action in [0, 1]; from it on an action counts as at its limit."""
MANY_AT_LIMIT = 0.1
"""Share in [0, 1] of rows with an action at its limit; above it the action is warned of."""
HARDLY_USED = 0.05
"""Largest absolute value of an action in [0, 1]; an action that stays below it is warned of."""
FEW_ROWS = 100
"""Number of rows; fewer are warned of."""
_STILL = 1e-9
"""Range of the values over the largest of them; up to it, a channel counts as one that never moves."""
COARSE = 1.0
"""Ratio of the step of a signal's readings to the standard deviation of its change in a row; from it on it is told."""
_TURNS = {"rad": 2.0 * np.pi, "deg": 360.0, "°": 360.0}
"""A turn by the unit of an angle."""


@dataclass(frozen=True)
class Channel:
    """A signal, an action, or an input that only tells of a drive, over the whole log.

    Its `unit` is its own, and empty where the spec does not give it.
    `low` and `high` are the smallest and the largest value, `step` is the standard deviation of changes from row to
    row, `at_limits` the share of rows in which an action is at an end of its range, and `resolution` the step in which
    a signal is read, 0 where none can be seen.
    """

    name: str
    kind: str
    unit: str
    low: float
    high: float
    step: float
    at_limits: float = 0.0
    resolution: float = 0.0

    @property
    def moves(self) -> bool:
        """Whether it ever changes."""
        return self.high - self.low > _STILL * max(abs(self.low), abs(self.high), 1e-300)


def action_names(task: Task) -> tuple[str, ...]:
    """Names of an action's values."""
    if task.actions:
        return tuple(channel.name for channel in task.actions)
    return tuple(f"action[{index}]" for index in range(task.action_size))


def channels_of(dataset: Dataset, task: Task, robot: Robot | None = None) -> tuple[Channel, ...]:
    """Signals, then actions."""
    logged = dataset.transitions
    observation, following = np.asarray(logged.observation), np.asarray(logged.next_observation)
    both = np.concatenate([observation, following])
    units = [signal.unit or "" for signal in robot.signals] if robot else []
    units += [""] * (task.observation_size - len(units))  # of velocities that were derived from positions too
    numbers = np.column_stack([both.min(0), both.max(0), (following - observation).std(0)]).tolist()
    rows = zip(task.signal_names, units, numbers, observation.T, strict=True)
    signals = [
        Channel(name, "signal", unit, low, high, step, resolution=resolution_of(read))
        for name, unit, (low, high, step), read in rows
    ]
    scaled_action = np.asarray(logged.action)
    physical = physical_actions(scaled_action, task)
    within = np.ones(len(dataset), dtype=bool)
    within[dataset.episode_ends - 1] = False  # the next row is of another episode
    change = np.diff(physical, axis=0)[within[:-1]]
    step = change.std(0) if len(change) else np.zeros(task.action_size)
    units = [channel.unit for channel in task.actions] or [""] * task.action_size
    limits = (np.abs(scaled_action) >= AT_LIMIT).mean(0)
    numbers = np.column_stack([physical.min(0), physical.max(0), step, limits]).tolist()
    kinds = ["action" if channel.command else "input" for channel in task.actions] or ["action"] * task.action_size
    columns = zip(action_names(task), kinds, units, numbers, strict=True)
    return (*signals, *(Channel(name, kind, unit, *values) for name, kind, unit, values in columns))


def channel_findings(dataset: Dataset, parameters: int, channels: tuple[Channel, ...]) -> list[Finding]:
    """Findings on too few rows, channels that never move, signals read in coarse steps, and actions at limits."""
    findings = _size_findings(dataset, parameters)
    signals, actions = ([channel for channel in channels if channel.kind == kind] for kind in ("signal", "action"))
    nothing_moves = not any(channel.moves for channel in signals)
    for channel in (*signals, *actions):
        if not channel.moves:
            level: Level = "fatal" if nothing_moves and channel.kind == "signal" else "warning"
            what = f"it never moves: {channel.low + 0.0:g} in all {len(dataset):,} rows"
            dead = "a dead sensor, or the wrong column?"
            remedy = dead if channel.kind == "signal" else "is it the column of the command?"
            findings.append(Finding(level, what, channel.name, remedy))
    for channel, column in zip(actions, np.asarray(dataset.transitions.action).T, strict=False):  # inputs are last
        if channel.moves:
            findings += _limit_findings(channel, column)
    return findings + [
        _step_finding(channel) for channel in signals if channel.resolution > COARSE * channel.step > 0.0
    ]


def _step_finding(channel: Channel) -> Finding:
    step, unit = channel.resolution, f" {channel.unit}" if channel.unit else ""
    counts = _TURNS.get(channel.unit, 0.0) / step
    whole = counts > 10.0 and abs(counts / max(1.0, np.round(counts)) - 1.0) < 1e-3
    of_turn = f", {counts:,.0f} a turn" if whole else ""
    what = f"it is read in steps of {step:.3g}{unit}{of_turn}, and changes by {channel.step:.2g}{unit} in a row"
    remedy = (
        "single rows show the sensor's steps, not the motion: compare over longer windows, as "
        "--set least-squares.horizon=20 does"
    )
    return Finding("warning", what, channel.name, remedy)


def _size_findings(dataset: Dataset, parameters: int) -> list[Finding]:
    rows = len(dataset)
    if rows < parameters:
        what = f"{rows} rows for {parameters} parameters"
        return [Finding("fatal", what, dataset.origin, "record more, or calibrate fewer")]
    if rows < FEW_ROWS:
        return [Finding("warning", f"only {rows} rows", dataset.origin, "record a minute or more")]
    return []


def _limit_findings(channel: Channel, scaled_action: Float[np.ndarray, " rows"]) -> list[Finding]:
    largest = float(np.abs(scaled_action).max())
    if channel.at_limits > MANY_AT_LIMIT:
        what = f"it stands at an end of its range in {100 * channel.at_limits:.0f} % of the rows"
        remedy = "if the driver clips there, log what it applied and not what was asked for"
    elif largest < HARDLY_USED:
        what = f"it stays within {100 * largest:.2g} % of its range"
        remedy = "is the log's unit that of the spec? Else excite the robot more"
    else:
        return []
    return [Finding("warning", what, channel.name, remedy)]


def physical_actions(scaled_action: Float[np.ndarray, "rows action"], task: Task) -> Float[np.ndarray, "rows action"]:
    """Actions in the units of their channels."""
    if not task.actions:
        return scaled_action
    low, high = (np.array([getattr(channel, end) for channel in task.actions]) for end in ("low", "high"))
    return low + (scaled_action + 1.0) / 2.0 * (high - low)


def refuse_fatal(findings: tuple[Finding, ...]) -> None:
    """Refuse a log that has a fatal finding.

    Raises:
        MadocError: It has one; its sentence is the message.
    """
    fatal = [finding for finding in findings if finding.level == "fatal"]
    if fatal:
        more = f" (and {len(fatal) - 1} more: madoc check tells)" if len(fatal) > 1 else ""
        raise MadocError(f"the data is refused: {fatal[0].sentence}{more}")
