"""The machine: MuJoCo stepped with what a case adds to it, by itself and never through Madoc."""

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from adversary_cases.case import Case, Plant, Robot

SWAY_HZ = 0.7
"""Hz, of a base that sways."""
STRIBECK_SPEED = 0.3
"""rad/s or m/s, at which Stribeck friction has fallen by 63 % of its fall."""
REVERSAL_SPEED = 0.01
"""rad/s or m/s, below which such friction rises linearly with speed, so that it has no step."""
BUILD_UP = 0.1
"""rad or m, over which friction with presliding comes 63 % nearer to its full size after a reversal (Dahl 1968)."""
WARM_AFTER = 3.0
"""s, in which a machine has warmed up by 63 %, so that its friction or what its motors exert has changed as much."""


@dataclass
class Inside:
    """What a machine carries from one physics step to the next that is not in its positions and velocities.

    Attributes:
        motor: What the motors follow; nothing before the first command.
        friction: Share of its friction that has built up on each degree of freedom, in [-1, 1], against the motion.
    """

    motor: np.ndarray | None
    friction: np.ndarray


@dataclass(frozen=True)
class Run:
    """One run as its sensors show it: `time` (s), `signals` (SI units) and `commands` (as sent), all by row."""

    time: np.ndarray
    signals: np.ndarray
    commands: np.ndarray


def truth_of(case: Case, seed: int) -> dict[str, float]:
    """Values of the machine, in the middle half of each range; the same for every case of a robot and seed."""
    random = np.random.default_rng([seed, *case.robot.name.encode()])
    drawn = {
        name: free.low + (free.high - free.low) * random.uniform(0.25, 0.75)
        for name, free in case.robot.catalogue.items()
    }
    values = {**case.robot.values, **{name: drawn[name] for name in case.free}, **case.plant.values}
    return {name: value * case.plant.factors.get(name, 1.0) for name, value in values.items()}


def record(case: Case, truth: Mapping[str, float], random: np.random.Generator) -> list[Run]:
    """All runs of a case; parts of the runs, one after the other, differ where `by_run` says so."""
    parts, count = case.plant.by_run, case.log.runs
    values = [{**truth, **parts[index * len(parts) // count]} for index in range(count)]
    trial = record_run(case, values[0], 0.0, np.random.default_rng(0))
    noise = case.log.noise * trial.signals.std(axis=0)
    return [record_run(case, each, noise, random) for each in values]


def record_run(case: Case, values: Mapping[str, float], noise: np.ndarray | float, random: np.random.Generator) -> Run:
    """One run from the robot's start, with noise of this standard deviation in each signal."""
    robot, plant, nominal = case.robot, case.plant, control_step(case)
    model, data = started(robot, values, random)
    rows = round(case.log.seconds / nominal)
    spacings = nominal * plant.spacing * (1.0 + plant.drift * np.arange(rows) / rows)
    low, high = limits_of(robot)
    middle, half = (low + high) / 2, (high - low) / 2
    targets = excitation(case, rows, random)
    push = plant.process * half.max() * random.standard_normal((rows, model.nv))
    places = addresses(robot, model)
    signals: list[np.ndarray] = []
    commands: list[np.ndarray] = []
    inside = Inside(None, np.zeros(model.nv))
    for row, spacing in enumerate(spacings):
        state = np.concatenate([data.qpos, data.qvel])
        reading = state[places] + noise * random.standard_normal(len(robot.signals))
        signals.append(quantised(case, reading))
        commands.append(middle + half * steered(case, targets[row], signals[-1]))
        move(case, model, data, commands, inside, push[row], spacing)
    times = np.concatenate([[0.0], np.cumsum(spacings)[:-1]])
    return Run(times, np.stack(signals), np.stack(commands))


def started(
    robot: Robot, values: Mapping[str, float], random: np.random.Generator
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The machine at the start of a run."""
    if any(action.kp is not None for action in robot.actions):
        values = {**values, "servo": values["servo"] or robot.actions[0].kp or 0.0}
    model = mujoco.MjModel.from_xml_string(robot.mjcf(values))
    data = mujoco.MjData(model)
    for index, position in robot.start.items():
        data.qpos[index] = position + 0.02 * random.standard_normal()
    mujoco.mj_forward(model, data)
    return model, data


def move(
    case: Case,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    commands: list[np.ndarray],
    inside: Inside,
    push: np.ndarray,
    spacing: float,
) -> None:
    """Step the machine, with what it carries inside, in place from one row to the next."""
    plant = case.plant
    low, high = limits_of(case.robot)
    middle, reach = (low + high) / 2, plant.limit * (high - low) / 2
    steps = max(1, round(spacing / case.robot.timestep)) * plant.fine
    model.opt.timestep = spacing / steps
    lags = np.full(len(low), plant.lag)
    lags[-1] = plant.last_lag or plant.lag
    keep = np.where(lags > 0.0, np.exp(-model.opt.timestep / np.maximum(lags, np.finfo(float).tiny)), 0.0)
    for step in range(steps):
        wanted = late(commands, plant.delay - step / steps)
        inside.motor = motor = wanted if inside.motor is None else wanted + keep * (inside.motor - wanted)
        cold = np.exp(-data.time / WARM_AFTER)
        followed = middle + (high - low) / 2 * driven(plant, 2 * (motor - middle) / (high - low))
        data.ctrl[:] = np.clip(followed, middle - reach, middle + reach) * (1.0 - plant.sag * (1.0 - cold))
        data.qfrc_applied[:] = push + resistance(plant, data.qvel) + of_gear(plant, data, cold)
        data.qfrc_applied[0] += plant.wind
        inside.friction = built_up(inside.friction, model.opt.timestep * data.qvel)
        data.qfrc_applied -= plant.presliding * inside.friction
        if plant.coupled:
            data.qfrc_applied[:2] -= plant.coupled * data.qvel[1::-1]
        if plant.sway:
            model.opt.gravity[0] = plant.sway * np.sin(2 * np.pi * SWAY_HZ * data.time)
        mujoco.mj_step(model, data)


def control_step(case: Case) -> float:
    """Time between two rows that the spec says, s."""
    return 1.0 / case.spec.rate if case.spec.rate else case.robot.control_step


def limits_of(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """The smallest and the largest command of each action."""
    return np.array([action.low for action in robot.actions]), np.array([action.high for action in robot.actions])


def late(commands: list[np.ndarray], rows: float) -> np.ndarray:
    """The command of so many rows ago; that of the first row before it."""
    return commands[max(0, len(commands) - 1 - max(0, int(np.ceil(rows))))]


def driven(plant: Plant, command: np.ndarray) -> np.ndarray:
    """What motors follow of commands in [-1, 1]."""
    if plant.coarse:
        command = plant.coarse * np.trunc(command / plant.coarse)
    return np.sign(command) * np.maximum(np.abs(command) - plant.dead_zone, 0.0)


def resistance(plant: Plant, speed: np.ndarray) -> np.ndarray:
    """Quadratic drag and Stribeck friction on every joint."""
    fall = 0.5 * (1.0 + np.exp(-((speed / STRIBECK_SPEED) ** 2)))
    return -plant.drag * np.abs(speed) * speed - plant.stribeck * fall * np.tanh(speed / REVERSAL_SPEED)


def of_gear(plant: Plant, data: mujoco.MjData, cold: float) -> np.ndarray:
    """What the gears of joints of one degree of freedom take: friction, and a ripple of what their motors exert."""
    if not (plant.loaded or plant.warming or plant.uneven or plant.ripple):
        return np.zeros_like(data.qvel)
    turn = np.sin(data.qpos)
    friction = plant.loaded * np.abs(data.qfrc_actuator) + plant.warming * cold + plant.uneven * turn
    return plant.ripple * data.qfrc_actuator * turn - friction * np.tanh(data.qvel / REVERSAL_SPEED)


def built_up(share: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Share of friction with presliding after a small motion: Dahl's dF/dx = (1 - F sign(v)) / distance, solved."""
    end = np.sign(moved)
    return end + (share - end) * np.exp(-np.abs(moved) / BUILD_UP)


def excitation(case: Case, rows: int, random: np.random.Generator) -> np.ndarray:
    """Random steps in [-1, 1] by row and action."""
    held = max(1, round(case.robot.hold / control_step(case)))
    return np.repeat(random.uniform(-1.0, 1.0, (rows // held + 1, len(case.robot.actions))), held, axis=0)[:rows]


def steered(case: Case, target: np.ndarray, signals: np.ndarray) -> np.ndarray:
    """The command in [-1, 1]: the random step itself, or what a controller sends that has it as its target."""
    if not case.plant.closed_loop:
        return target
    joints = len(case.robot.actions)
    stiffness, damping = case.robot.gains
    limit = np.array([action.high for action in case.robot.actions])
    return np.clip((stiffness * (target - signals[:joints]) - damping * signals[joints : 2 * joints]) / limit, -1, 1)


def quantised(case: Case, reading: np.ndarray) -> np.ndarray:
    """A reading whose positions are whole counts of the encoders."""
    step = case.log.quantum
    if not step:
        return reading
    positions = np.array([signal.kind == "position" for signal in case.robot.signals])
    return np.where(positions, step * np.round(reading / step), reading)


def addresses(robot: Robot, model: mujoco.MjModel) -> list[int]:
    """Where each signal stands in (qpos, qvel)."""
    places = []
    for signal in robot.signals:
        joint = model.joint(signal.joint).id
        start = model.jnt_qposadr[joint] if signal.kind == "position" else model.nq + model.jnt_dofadr[joint]
        places.append(int(start) + (signal.index or 0))
    return places
