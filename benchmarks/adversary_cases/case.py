"""The values that describe a case: its robot, what its plant does, how that is logged, and what the spec says."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import pi
from typing import Literal

NONE: Mapping[str, float] = {}
ENCODER = 2 * pi / 4096
"""rad, one count of a 12-bit encoder."""


@dataclass(frozen=True)
class Signal:
    """One logged number: the position or the velocity of a joint, or one component of it (rad, m, and per second)."""

    name: str
    joint: str
    kind: Literal["position", "velocity"] = "position"
    index: int | None = None

    @property
    def reads(self) -> str:
        """The expression of the spec."""
        return f"{self.kind}({self.joint})" + ("" if self.index is None else f"[{self.index}]")


@dataclass(frozen=True)
class Action:
    """One command and its limits. With `kp`, it is the target of a position servo that the spec describes."""

    name: str
    low: float
    high: float
    joint: str = ""
    kp: float | None = None
    kd: float | None = None

    @property
    def spec(self) -> dict[str, object]:
        """The entry of the spec."""
        limits = {"name": self.name, "low": self.low, "high": self.high}
        if self.kp is None:
            return {**limits, "actuator": self.name}
        return {**limits, "joint": self.joint, "means": "position", "kp": self.kp, "kd": self.kd}


@dataclass(frozen=True)
class Free:
    """A value of the model that a spec may calibrate, with its range there.

    Several elements that share the value are separated by spaces.
    """

    field: str
    element: str
    low: float
    high: float


@dataclass(frozen=True)
class Robot:
    """A machine and the model that a user would write of it.

    Attributes:
        name: Of the robot.
        mjcf: Model of given values; the plant and the user's model differ only by these.
        values: Every value that `mjcf` takes, as the user's model has it unless a case says otherwise.
        catalogue: Values that a spec may calibrate, by their names in `values`. Their truth is drawn from the seed.
        free: Those that a spec calibrates unless a case says otherwise.
        signals: What is logged.
        actions: What is commanded.
        timestep: Of the user's model, s.
        control_step: Between two rows, s.
        hold: Time between two changes of the command, s.
        gains: Of the controller in a closed loop: per rad or m, and per rad/s or m/s.
        start: Positions at the beginning of a run, by their index in `qpos`.
    """

    name: str
    mjcf: Callable[[Mapping[str, float]], str]
    values: Mapping[str, float]
    catalogue: Mapping[str, Free]
    free: tuple[str, ...]
    signals: tuple[Signal, ...]
    actions: tuple[Action, ...]
    timestep: float = 0.005
    control_step: float = 0.02
    hold: float = 0.2
    gains: tuple[float, float] = (0.0, 0.0)
    start: Mapping[int, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Plant:
    """How the machine differs from the user's model with the true values.

    Attributes:
        values: Of the machine, where they are not those of the model.
        factors: By which values of the machine are multiplied.
        by_run: More values, one mapping for each part of the runs (three mappings: thirds of the runs).
        fine: Physics steps in one time step of the model.
        spacing: Time between two rows, in control steps of the spec.
        drift: By how much the spacing grows over a run, as a share.
        lag: Time constant of the motors, s.
        last_lag: Time constant of the last motor alone, s.
        delay: Of the command, in rows.
        limit: Largest command that the motors follow, as a share of the logged limit.
        drag: Quadratic drag on every joint, N·s²/m² or N·m·s²/rad².
        stribeck: Stribeck friction on every joint, N or N·m; it falls to half of that with speed.
        presliding: Friction on every joint, N or N·m, that builds up over 0.1 rad or m after each reversal (Dahl).
        loaded: Friction on every joint, as a share of what its motor exerts.
        warming: Friction on every joint at the begin of each run, N or N·m; it falls off within seconds.
        uneven: Friction on every joint, N or N·m, times the sine of its position.
        ripple: Share of what its motor exerts on every joint that goes with the sine of its position.
        sag: Share of what the motors exert that they lose within seconds of each run.
        dead_zone: Command that the motors do not follow, a share of the largest: they follow what is beyond it.
        coarse: Step of the commands as motors follow them, cut towards zero, a share of the largest.
        coupled: Damping of each of the first two joints by the other's speed, N·m·s/rad.
        sway: Amplitude (m/s²) of a sideways acceleration of the base at 0.7 Hz.
        wind: Constant force on the first joint, N or N·m.
        process: Random force on every joint, one draw a row, as a share of the largest command.
        closed_loop: Whether a proportional-derivative controller commands it, instead of random steps.
    """

    values: Mapping[str, float] = field(default_factory=dict)
    factors: Mapping[str, float] = field(default_factory=dict)
    by_run: tuple[Mapping[str, float], ...] = (NONE,)
    fine: int = 1
    spacing: float = 1.0
    drift: float = 0.0
    lag: float = 0.0
    last_lag: float = 0.0
    delay: float = 0.0
    limit: float = 1.0
    drag: float = 0.0
    stribeck: float = 0.0
    presliding: float = 0.0
    loaded: float = 0.0
    warming: float = 0.0
    uneven: float = 0.0
    ripple: float = 0.0
    sag: float = 0.0
    dead_zone: float = 0.0
    coarse: float = 0.0
    coupled: float = 0.0
    sway: float = 0.0
    wind: float = 0.0
    process: float = 0.0
    closed_loop: bool = False


@dataclass(frozen=True)
class Log:
    """How the machine is logged.

    Attributes:
        runs: Number of files.
        seconds: Of each run.
        noise: Of each signal, as a share of its spread.
        action_noise: Of each logged command, as a share of its limit, as where torque is computed from current.
        quantum: Step of the position encoders, rad or m; 0 for none.
        velocities: Measured; differences of logged positions; passed through a filter; or not logged at all.
        positions: Measured, or passed through a filter, as from the estimator of a motor driver.
        filter: Time constant of these filters, s.
        scale: Factor on columns.
        offset: Added to columns.
        clip: Largest magnitude of columns.
        swap: Two columns that have each other's name.
        degrees: Whether all positions and velocities are written in degrees.
        jitter: Of the time column, as a share of the control step.
        nominal_time: Whether the time column counts control steps of the spec, whatever time really passed.
        dropped: Share of rows that are lost.
    """

    runs: int = 6
    seconds: float = 6.0
    noise: float = 0.005
    action_noise: float = 0.0
    quantum: float = 0.0
    velocities: Literal["measured", "differenced", "filtered", "none"] = "measured"
    positions: Literal["measured", "filtered"] = "measured"
    filter: float = 0.03
    scale: Mapping[str, float] = field(default_factory=dict)
    offset: Mapping[str, float] = field(default_factory=dict)
    clip: Mapping[str, float] = field(default_factory=dict)
    swap: tuple[str, str] | None = None
    degrees: bool = False
    jitter: float = 0.0
    nominal_time: bool = False
    dropped: float = 0.0


@dataclass(frozen=True)
class Spec:
    """How the spec and the user's model differ from what the robot has by default.

    Attributes:
        values: Of the user's model.
        free: Values that are calibrated; empty for the robot's own.
        ranges: Other ranges of these.
        rate: Rows per second; 0 for the robot's own.
        degrees: Whether the spec says that signals are in degrees.
    """

    values: Mapping[str, float] = field(default_factory=dict)
    free: tuple[str, ...] = ()
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    rate: float = 0.0
    degrees: bool = False


@dataclass(frozen=True)
class Case:
    """A problem whose answer is known.

    Attributes:
        robot: What is simulated.
        name: Of the case, unique within its robot.
        plant: What the machine does.
        log: How it is logged.
        spec: What the user says of it.
        cause: Regular expression, in small letters, of which the verdict must hold a match; empty for an honest case.
        invisible: Whether no data can show that something is wrong, so that it can only be named.
    """

    robot: Robot
    name: str
    plant: Plant = Plant()
    log: Log = Log()
    spec: Spec = Spec()
    cause: str = ""
    invisible: bool = False

    @property
    def honest(self) -> bool:
        """Whether model and spec are right."""
        return not self.cause

    @property
    def key(self) -> str:
        """The case's name with that of its robot."""
        return f"{self.robot.name}.{self.name}"

    @property
    def kind(self) -> str:
        """The family of the deception: the name up to its first dash."""
        return self.name.split("-")[0]

    @property
    def free(self) -> tuple[str, ...]:
        """Values that the spec calibrates."""
        return self.spec.free or self.robot.free
