"""The robot and the data of a run: read once, here, and handed on to the stages."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import PRNGKeyArray

from madoc import data, robots, simulation, tasks
from madoc.data import Dataset, Disturbance, logs
from madoc.data.native import recognises as is_recorded
from madoc.errors import MadocError, about, unknown_name
from madoc.pipeline.orders import NO_PERMISSION, Permission, RecordOrder, Source
from madoc.pipeline.refusals import check_counts, check_seed, stage_key
from madoc.policies.behaviours import QUALITIES, record_quality
from madoc.report.records import SpecRecord
from madoc.robots import Robot
from madoc.runs.progress import bar
from madoc.simulation import Simulator
from madoc.tasks import TASKS, Task


@dataclass(frozen=True)
class Machine:
    """A robot with all of its parameters at their normal ranges, and the content of its spec file, if it has one."""

    task: Task
    robot: Robot | None = None

    @classmethod
    def named(cls, name: str, physics: str | None = None, *, permission: Permission = NO_PERMISSION) -> "Machine":
        """The robot that a command names: one of Madoc's, or the path of a spec file.

        Raises:
            MadocError: There is no such robot, or its spec is refused.
        """
        if robots.is_spec_path(name) and physics != "legacy":
            robot = robots.load(name, **vars(permission))
            return cls(robot.task, robot)
        return cls(robots.resolve(name, physics))

    @classmethod
    def restored(cls, spec: SpecRecord, *, permission: Permission = NO_PERMISSION) -> "Machine":
        """The robot of a run, from its `spec.json` alone.

        Raises:
            MadocError: The spec names no robot, or keeps one that cannot be made.
        """
        if spec.robot is not None:
            robot = robots.restore(spec.robot, allow_code=permission.allow_code)
            return cls(robot.task, robot)
        return cls(tasks.make(spec.task, spec.physics or "legacy"))

    def in_physics(self, physics: str) -> "Machine":
        """The same robot in other physics; a user's own robot has only its own."""
        same = self.robot is not None or physics == self.task.physics
        return self if same else Machine(tasks.make(self.task.name, physics))

    def at(self, truth: Mapping[str, float]) -> tuple[Simulator, np.ndarray]:
        """The target that policies act in: a simulator of all parameters that the truth names, and their values."""
        simulator = simulation.make(
            replace(self.task.for_policies, parameters=self.task.parameters.select(list(truth)))
        )
        return simulator, simulator.parameters.vector(truth)

    def stored(self) -> dict[str, object]:
        """The entry of a user's own robot in `spec.json`, from which it is restored; nothing for one of Madoc's."""
        return {} if self.task.source is None else {"robot": dict(self.task.source)}


def split_name(name: str) -> tuple[str, str]:
    """`hopper-medium-replay` as (`hopper`, `medium-replay`); the quality of a bare `hopper` or `arm.yaml` is empty.

    Raises:
        MadocError: There is no such task, or no such quality.
    """
    if robots.is_spec_path(name):
        return name, ""
    task_name, _, quality = name.partition("-")
    if task_name not in TASKS:
        raise unknown_name("task", task_name, TASKS)
    if quality and quality not in QUALITIES:
        raise unknown_name("quality", quality, QUALITIES)
    return task_name, quality


def record(simulator: Simulator, quality: str, *, transitions: int, key: PRNGKeyArray, quiet: bool = False) -> Dataset:
    """Record this many rows of one of the paper's datasets in the target with the paper's truth.

    The quality is `medium`, `medium-replay`, `medium-expert`, `neorl-low`, `neorl-medium` or `neorl-high`.

    Raises:
        MadocError: The quality is unknown, no behaviour policies are shipped for the robot, or no row is wanted.
    """
    check_counts(transition=transitions)
    name = f"{simulator.task.name}-{quality}"
    with bar(f"recording {name}", total=transitions, unit="transitions", quiet=quiet) as advance:
        return record_quality(simulator, quality, transitions=transitions, key=key, advance=advance)


def check_recording(order: RecordOrder) -> tuple[str, str, Disturbance]:
    """The task of a recording, its quality, and all that is disturbed in it.

    Raises:
        MadocError: The name is no TASK-QUALITY, no row is wanted, or the seed or the friction is impossible.
    """
    with about("name"):
        task, quality = split_name(order.name)
        if not quality:
            raise MadocError(
                f"expected TASK-QUALITY, got {order.name!r}; for example {task}-medium, of: {', '.join(QUALITIES)}"
            )
    check_counts(transition=order.transitions)
    check_seed(order.seed)
    with about("friction"):
        return task, quality, replace(order.disturbance, friction=order.friction)


def record_named(order: RecordOrder, *, quiet: bool = False) -> Dataset:
    """Record `TASK-QUALITY` in the target with the paper's truth, its contacts and sensors disturbed if asked.

    Raises:
        MadocError: `check_recording` or `record` refuses.
    """
    task_name, quality, asked = check_recording(order)
    key = stage_key(order.seed, "recording")
    task = tasks.make(task_name, order.physics)
    simulator = simulation.make(task if asked.friction == 1.0 else task.with_friction(asked.friction))
    dataset = record(simulator, quality, transitions=order.transitions, key=key, quiet=quiet)
    return data.disturb(dataset, asked, task, stage_key(order.seed, "disturbing"))


def load_source(source: Source, machine: Machine, *, seed: int) -> Dataset:
    """Read logged data of a robot, and disturb it if the source says so.

    Raises:
        MadocError: As `data.load`, or `logs.read` for a user's own robot, and `data.disturb`; or friction is to be
            changed after the fact, or several files are given where one is read.
    """
    task, reading = machine.task, source.reading
    if reading.disturbance.friction != 1.0:
        raise MadocError("the friction of a target is chosen when it is recorded; pass it to madoc record")
    key = stage_key(seed, "subsampling")
    if machine.robot is not None and reading.format is None and not is_recorded(Path(source.paths[0])):
        dataset = logs.read(source.paths, machine.robot, clip_actions=reading.clip_actions)
        if source.max_transitions is not None:
            dataset = data.subsample(dataset, source.max_transitions, key)
    else:
        if len(source.paths) != 1:
            raise MadocError(
                f"expected one file or dataset of {task.name}, got {len(source.paths)}: {', '.join(source.paths)}"
            )
        dataset = data.load(
            source.paths[0],
            task,
            format=reading.format,
            max_transitions=source.max_transitions,
            key=key,
            clip_actions=reading.clip_actions,
        )
    return data.disturb(dataset, reading.disturbance, task, stage_key(seed, "disturbing"))


def fingerprint(dataset: Dataset) -> str:
    """A checksum of the transitions: a run is only resumed on the data it was started with."""
    logged, total = dataset.transitions, 0
    for column in (logged.observation, logged.action, logged.next_observation, logged.terminated):
        total = zlib.crc32(np.ascontiguousarray(column).tobytes(), total)
    return f"{total:08x}"
