"""A robot of one's own over the two-link arm, and its log as columns: what a user has."""

from pathlib import Path

import jax
import numpy as np

from madoc import robots as own
from madoc import simulation
from robots import ARM

SPEC = """\
madoc: 1
name: arm
model: arm.xml
control_step: 0.02
signals:
  - {name: shoulder, reads: position(shoulder)}
  - {name: elbow, reads: position(elbow)}
  - {name: shoulder_speed, reads: velocity(shoulder)}
  - {name: elbow_speed, reads: velocity(elbow)}
actions:
  - {name: shoulder_torque, actuator: shoulder, low: -0.5, high: 0.5, unit: N·m}
  - {name: elbow_torque, actuator: elbow, low: 0, high: 0.4, unit: N·m}
parameters:
  - {field: body_mass, element: upper, low: 0.5, high: 2.0}
  - {field: body_mass, element: fore, low: 0.2, high: 1.0}
  - {field: dof_damping, element: shoulder, low: 0, high: 1}
  - {field: dof_damping, element: elbow, low: 0, high: 0.5}
"""
SIGNALS = ("shoulder", "elbow", "shoulder_speed", "elbow_speed")
ACTIONS = ("shoulder_torque", "elbow_torque")
TRUTH = np.array([1.5, 0.4, 0.3, 0.35])


def arm_of(folder: Path, spec: str = SPEC, *, log: str = "", model: str = ARM) -> own.Robot:
    """The robot, its files written into a folder; `log` is the spec's section of that name."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.xml").write_text(model)
    (folder / "arm.yaml").write_text(spec + (f"log: {log}\n" if log else ""))
    return own.load(folder / "arm.yaml")


def columns_of(robot: own.Robot, rows: int = 50, *, seed: int = 0, truth: np.ndarray = TRUTH) -> dict[str, np.ndarray]:
    """A run of the arm at the truth under slowly changing torques; each row is what was seen and then done."""
    simulator = simulation.make(robot.task, threads=1)
    system = simulator.bind(truth[None])
    torques = np.asarray(jax.random.uniform(jax.random.key(seed), (rows // 5 + 1, 2), minval=-1.0, maxval=1.0))
    action = np.repeat(torques.astype(np.float64), 5, axis=0)[:rows]
    state = simulator.initial_state[None, None]
    seen = []
    for row in action:
        seen.append(system.observe(state)[0, 0])
        state = system.step(state, row[None, None])
    low, high = (np.array([getattr(channel, end) for channel in robot.actions]) for end in ("low", "high"))
    physical = low + (action + 1.0) / 2.0 * (high - low)
    names = [*(channel.name for channel in robot.signals), *(channel.name for channel in robot.actions)]
    return dict(zip(("time", *names), (0.02 * np.arange(rows), *np.stack(seen).T, *physical.T), strict=True))


def write_csv(path: Path, columns: dict[str, np.ndarray], separator: str = ",") -> Path:
    """Columns with all of their digits."""
    lines = [
        separator.join(columns),
        *(separator.join(map(repr, map(float, row))) for row in zip(*columns.values(), strict=True)),
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return path


def matrix(columns, names):
    return np.stack([columns[name] for name in names], axis=-1)


def assert_same(dataset, columns, *, atol=0.0):
    """One episode that holds exactly the columns, actions brought to [-1, 1] by hand."""
    seen = matrix(columns, SIGNALS)
    unit = np.stack([columns["shoulder_torque"] / 0.5, columns["elbow_torque"] / 0.2 - 1.0], axis=-1)
    logged = dataset.transitions
    np.testing.assert_allclose(logged.observation, seen[:-1], rtol=0, atol=atol)
    np.testing.assert_allclose(logged.next_observation, seen[1:], rtol=0, atol=atol)
    np.testing.assert_allclose(logged.action, unit[:-1], rtol=0, atol=1e-12 + atol)
    assert dataset.episode_starts.tolist() == [0]
    assert logged.truncated.tolist() == [False] * (len(seen) - 2) + [True]
    assert not logged.terminated.any()
    assert not logged.reward.any()


def named(signal, action, time="time"):
    """The `log:` section where signals and actions are elements of arrays."""
    pairs = [f"{name}: '{signal}[{index}]'" for index, name in enumerate(SIGNALS)]
    pairs += [f"{name}: '{action}[{index}]'" for index, name in enumerate(ACTIONS)]
    return f"{{time: {time}, columns: {{{', '.join(pairs)}}}}}"
