"""Channels of a log: which of them never move, are at a limit, or contradict each other."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from madoc.data import Dataset
from madoc.data.findings import Finding, Level
from madoc.errors import MadocError
from madoc.robots import Robot
from madoc.simulation import Simulator
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
_UNIT_ERRORS = {
    180.0 / np.pi: "one in degrees, the other in radians",
    1000.0: "one in thousandths (mm, ms) of the other",
    100.0: "one in cm, the other in m",
    2.0 * np.pi: "one in turns, the other in radians",
    30.0 / np.pi: "a speed in rpm",
    -1.0: "one of them with its sign reversed",
}
"""Mistakes by the ratio, or its inverse, of a position's changes to those that its speed implies."""
_TRUSTED = 0.5
"""Squared correlation in [0, 1] of a position's changes with its speed; below it their ratio is not judged."""


@dataclass(frozen=True)
class Channel:
    """A signal or an action over the whole log, in its own unit, which is empty where the spec does not give it.

    `low` and `high` are the smallest and the largest value, `step` is the standard deviation of changes from row to
    row, and `at_limits` the share of rows in which an action is at an end of its range.
    """

    name: str
    kind: str
    unit: str
    low: float
    high: float
    step: float
    at_limits: float = 0.0

    @property
    def moves(self) -> bool:
        """Whether it ever changes."""
        return self.high - self.low > _STILL * max(abs(self.low), abs(self.high), 1e-300)


def signal_names(task: Task) -> tuple[str, ...]:
    """Names of an observation's values."""
    return task.signals or tuple(f"observation[{index}]" for index in range(task.observation_size))


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
    columns = zip(signal_names(task), units, numbers, strict=True)
    signals = [Channel(name, "signal", unit, *values) for name, unit, values in columns]
    scaled_action = np.asarray(logged.action)
    physical = _physical(scaled_action, task)
    within = np.ones(len(dataset), dtype=bool)
    within[dataset.episode_ends - 1] = False  # the next row is of another episode
    change = np.diff(physical, axis=0)[within[:-1]]
    step = change.std(0) if len(change) else np.zeros(task.action_size)
    units = [channel.unit for channel in task.actions] or [""] * task.action_size
    limits = (np.abs(scaled_action) >= AT_LIMIT).mean(0)
    numbers = np.column_stack([physical.min(0), physical.max(0), step, limits]).tolist()
    columns = zip(action_names(task), units, numbers, strict=True)
    return (*signals, *(Channel(name, "action", unit, *values) for name, unit, values in columns))


def channel_findings(dataset: Dataset, simulator: Simulator, channels: tuple[Channel, ...]) -> list[Finding]:
    """Findings on too few rows, channels that never move, actions at limits, and positions that contradict speeds."""
    findings = _size_findings(dataset, len(simulator.parameters))
    signals, actions = ([channel for channel in channels if channel.kind == kind] for kind in ("signal", "action"))
    nothing_moves = not any(channel.moves for channel in signals)
    for channel in (*signals, *actions):
        if not channel.moves:
            level: Level = "fatal" if nothing_moves and channel.kind == "signal" else "warning"
            what = f"it never moves: {channel.low + 0.0:g} in all {len(dataset):,} rows"
            dead = "a dead sensor, or the wrong column?"
            remedy = dead if channel.kind == "signal" else "is it the column of the command?"
            findings.append(Finding(level, what, channel.name, remedy))
    for channel, column in zip(actions, np.asarray(dataset.transitions.action).T, strict=True):
        if channel.moves:
            findings += _limit_findings(channel, column)
    return findings + _speed_findings(dataset, simulator)


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


def _speed_findings(dataset: Dataset, simulator: Simulator) -> list[Finding]:
    """Findings on positions that do not change by speed times control step: wrong units or signs, wrapped angles."""
    task = simulator.task
    if task.state_from_observation is None:
        return []
    model = task.compile()
    if model.nq != model.nv:
        return []
    logged = dataset.transitions
    before, after = (
        np.asarray(task.state_from_observation(np.asarray(part, np.float64)))[:, : 2 * model.nv]
        for part in (logged.observation, logged.next_observation)
    )
    names = _names_of_states(task, 2 * model.nv)
    findings = []
    for dof in range(model.nv):
        position, speed = names[dof], names[model.nv + dof]
        if position is None or speed is None:
            continue
        change = after[:, dof] - before[:, dof]
        expected = 0.5 * (before[:, model.nv + dof] + after[:, model.nv + dof]) * simulator.control_step
        turned = np.abs(np.abs(change) - 2.0 * np.pi) < 0.1 * 2.0 * np.pi
        turned &= np.abs(change - expected) > np.pi
        if turned.any():
            what = f"it jumps by a whole turn in {int(turned.sum())} rows"
            findings.append(Finding("warning", what, position, "unwrap the angle where it is logged"))
        findings += _ratio_findings(change[~turned], expected[~turned], position, speed)
    return findings


def _ratio_findings(change: np.ndarray, expected: np.ndarray, position: str, speed: str) -> list[Finding]:
    power = float(expected @ expected)
    if power == 0.0 or not np.any(change):
        return []
    together = float(change @ expected)
    if together**2 < _TRUSTED * power * float(change @ change):
        return []
    ratio = together / power
    if 0.8 < ratio < 1.25:
        return []
    factors = ((each, text) for factor, text in _UNIT_ERRORS.items() for each in (factor, 1.0 / factor))
    mistake = next((f": {text}?" for factor, text in factors if abs(ratio / factor - 1.0) < 0.1), "")
    what = f"it changes {ratio:.3g} times as fast as {speed} says{mistake}"
    return [Finding("warning", what, position, "look at units and signs in the spec and at control_step")]


def _names_of_states(task: Task, size: int) -> list[str | None]:
    """The signal from which each value of (qpos, qvel) is rebuilt; None where there is not exactly one."""
    assert task.state_from_observation is not None
    names, width = signal_names(task), task.observation_size
    base = np.asarray(task.state_from_observation(np.zeros((1, width))))[:, :size]
    moved = np.asarray(task.state_from_observation(np.eye(width)))[:, :size] - base
    sources = [np.flatnonzero(np.abs(moved[:, column]) > 1e-12) for column in range(size)]
    return [names[source[0]] if len(source) == 1 else None for source in sources]


def _physical(scaled_action: Float[np.ndarray, "rows action"], task: Task) -> Float[np.ndarray, "rows action"]:
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
