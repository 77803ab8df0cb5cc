"""The data of a run: recorded, or read from a file."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from madoc import data, robots, simulation, tasks
from madoc.data import Dataset, Disturbance, logs
from madoc.data.native import recognises as is_recorded
from madoc.errors import MadocError, unknown_name
from madoc.pipeline.keys import stage_key
from madoc.policies.behaviours import QUALITIES, record_quality
from madoc.runs.files import read_json
from madoc.runs.progress import bar
from madoc.simulation import Simulator
from madoc.tasks import TASKS, Task


@dataclass(frozen=True)
class Source:
    """Where logged data is and how to read it.

    Attributes:
        paths: A file, a Minari directory or a Minari id; of a robot of one's own also several files or folders.
        format: A name in `data.FORMATS`; None looks at the content.
        clip_actions: Clip actions outside [-1, 1] instead of refusing them.
        max_transitions: Keep at most so many, drawn as whole episodes; None keeps all.
        disturbance: What to put into it once it is read.
    """

    paths: tuple[str, ...]
    format: str | None = None
    clip_actions: bool = False
    max_transitions: int | None = 200_000
    disturbance: Disturbance = field(default_factory=Disturbance)

    @property
    def words(self) -> str:
        """The paths as a sentence has them."""
        return ", ".join(self.paths)


def absolute_source(source: Source) -> Source:
    """A source that means the same from any working directory; a Minari id stays what it is."""
    files = [Path(path).expanduser() for path in source.paths]
    whole = (str(file.resolve()) if file.exists() else path for file, path in zip(files, source.paths, strict=True))
    return replace(source, paths=tuple(whole))


@dataclass(frozen=True)
class Target:
    """What a policy is for: the simulator at the true parameters."""

    simulator: Simulator
    parameters: np.ndarray


def split_name(name: str) -> tuple[str, str]:
    """`hopper-medium-replay` as (`hopper`, `medium-replay`); the quality of a bare `hopper` or `arm.yaml` is empty.

    Raises:
        MadocError: No such task, or no such quality.
    """
    if robots.is_spec_path(name):
        return name, ""
    task_name, _, quality = name.partition("-")
    if task_name not in TASKS:
        raise unknown_name("task", task_name, TASKS)
    if quality and quality not in QUALITIES:
        raise unknown_name("quality", quality, QUALITIES)
    return task_name, quality


def record_named(
    name: str,
    *,
    transitions: int,
    physics: str,
    seed: int,
    disturbance: Disturbance | None = None,
    quiet: bool = True,
) -> Dataset:
    """Record `TASK-QUALITY` in the target with the paper's truth, its contacts and sensors disturbed if asked.

    Raises:
        MadocError: The name is no TASK-QUALITY, or `record_quality` refuses.
    """
    task_name, quality = split_name(name)
    if not quality:
        raise MadocError(
            f"expected TASK-QUALITY, got {name!r}; for example {task_name}-medium, of: {', '.join(QUALITIES)}"
        )
    if transitions < 1:
        raise MadocError(f"expected at least 1 transition to record, got {transitions}")
    key = stage_key(seed, "recording")
    asked = disturbance or Disturbance()
    task = tasks.make(task_name, physics)
    simulator = simulation.make(task if asked.friction == 1.0 else task.with_friction(asked.friction))
    with bar(f"recording {name}", total=transitions, unit="transitions", quiet=quiet) as advance:
        dataset = record_quality(simulator, quality, transitions=transitions, key=key, advance=advance)
    return data.disturb(dataset, asked, task, stage_key(seed, "disturbing"))


def load_source(source: Source, task: Task, *, seed: int) -> Dataset:
    """Read logged data of a robot, and disturb it if the source says so.

    Raises:
        MadocError: As `data.load`, or `logs.read` for a robot of one's own, and `data.disturb`; or friction is to be
            changed after the fact, or several files are given where one is read.
    """
    if source.disturbance.friction != 1.0:
        raise MadocError("the friction of a target is chosen when it is recorded; pass it to madoc record")
    key = stage_key(seed, "subsampling")
    if task.source is not None and source.format is None and not is_recorded(Path(source.paths[0])):
        robot = robots.restore_robot(task.source)
        dataset = logs.read(source.paths, robot, clip_actions=source.clip_actions)
        if source.max_transitions is not None:
            dataset = data.subsample(dataset, source.max_transitions, key)
    else:
        if len(source.paths) != 1:
            raise MadocError(f"expected one file or dataset of {task.name}, got {len(source.paths)}: {source.words}")
        dataset = data.load(
            source.paths[0],
            task,
            format=source.format,
            max_transitions=source.max_transitions,
            key=key,
            clip_actions=source.clip_actions,
        )
    return data.disturb(dataset, source.disturbance, task, stage_key(seed, "disturbing"))


def fingerprint(dataset: Dataset) -> str:
    """A checksum of the transitions: a run is only resumed on the data it was started with."""
    logged, total = dataset.transitions, 0
    for column in (logged.observation, logged.action, logged.next_observation, logged.terminated):
        total = zlib.crc32(np.ascontiguousarray(column).tobytes(), total)
    return f"{total:08x}"


def read_truth(path: Path) -> dict[str, float]:
    """True parameters from a JSON file `{name: value}`.

    Raises:
        MadocError: Missing, no JSON, or not numbers by name.
    """
    values = read_json(path)
    if not isinstance(values, dict) or not values:
        raise MadocError(f'expected {{"parameter": value, ...}} in {path}, got {type(values).__name__}')
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise MadocError(f"expected a finite number for {name} in {path}, got {value!r}")
    return {name: float(value) for name, value in values.items()}


def check_truth(truth: Mapping[str, float], task: Task, *, physics: str) -> None:
    """Refuse a truth that does not say every calibrated parameter, or says one the robot does not have.

    Raises:
        MadocError: Names the parameter.
    """
    known = robots.remake(task, physics).parameters.names
    for name in truth:
        if name not in known:
            raise unknown_name(f"parameter of {task.name} in the truth", name, known)
    missing = [name for name in task.parameters.names if name not in truth]
    if missing:
        raise MadocError(f"the truth has no value for {missing[0]}; add it, or leave it out of --parameters")


def make_target(task: Task, truth: Mapping[str, float]) -> Target:
    """The target: all true parameters are bound, also those that were not calibrated."""
    whole = robots.remake(task)
    simulator = simulation.make(replace(whole, parameters=whole.parameters.select(list(truth))))
    return Target(simulator, simulator.parameters.vector(dict(truth)))


def stored_robot(task: Task) -> dict[str, Any]:
    """What a run's spec.json keeps of a robot of one's own, so that the folder is complete; nothing of Madoc's."""
    return {} if task.source is None else {"robot": dict(task.source)}


def task_of_spec(spec: Mapping[str, Any]) -> Task:
    """The robot of a run, from its spec.json alone.

    Raises:
        MadocError: It names no robot, or keeps one that cannot be made.
    """
    return robots.restore(spec["robot"]) if "robot" in spec else tasks.make(spec["task"], spec["physics"])
