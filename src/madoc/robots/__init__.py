"""A robot of one's own: a spec file and a model, made into a task.

`load` reads a spec, `resolve` takes the name of a robot or the path of a spec, `restore` makes a task again from what
a run folder keeps. The file is described in `spec.py`, and `schema()` is its JSON schema.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from madoc import tasks
from madoc.errors import MadocError, unknown_name
from madoc.robots.model import ModelFiles
from madoc.robots.spec import RobotSpec, read_spec
from madoc.robots.task import Parts, Signal, make_task
from madoc.tasks import TASKS, ActionChannel, Task

SUFFIXES = (".yaml", ".yml")


@dataclass(frozen=True)
class Robot:
    """A robot of one's own.

    Attributes:
        path: Its spec file.
        spec: What that says.
        task: The robot as the rest of Madoc knows it.
        signals: The values of an observation, in order.
        actions: The values of an action, in order; data has them in [-1, 1] of `low` and `high`.
        undetermined: What keeps a state from being rebuilt from an observation, in words.
        notes: What one should know of it, one sentence each.
    """

    path: Path
    spec: RobotSpec
    task: Task
    signals: tuple[Signal, ...]
    actions: tuple[ActionChannel, ...]
    undetermined: tuple[str, ...]
    notes: tuple[str, ...]


def load(path: str | Path) -> Robot:
    """Read a spec file and its model.

    Raises:
        MadocError: One sentence: the file, the line, what was expected, what is there, the nearest names.
    """
    file = Path(path).expanduser()
    if not file.is_file():
        what = "is a directory" if file.is_dir() else "does not exist"
        raise MadocError(
            f"expected the spec file of a robot, got {file}, which {what}; write one with: madoc init MODEL"
        )
    try:
        content = file.read_bytes()
    except OSError as error:
        raise MadocError(f"could not read {file}: {error.strerror or error}") from error
    spec, document = read_spec(content, file.name)
    try:
        model = ModelFiles.read(file.parent / spec.model)
    except MadocError as error:
        raise document.error(("model",), str(error)) from error
    return _robot(file, content, model)


def restore(source: Mapping[str, Any]) -> Task:
    """The task that `Task.source` describes, without any file: what a run folder keeps is enough.

    Raises:
        MadocError: It is no such description.
    """
    return restore_robot(source).task


def restore_robot(source: Mapping[str, Any]) -> Robot:
    """The robot that `Task.source` describes, as `restore`.

    Raises:
        MadocError: It is no such description.
    """
    try:
        file, content = Path(source["file"]), source["spec"].encode()
        model = ModelFiles.from_json(source["model"])
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise MadocError(f"the robot in this run's spec.json cannot be read: {error}; restore the file") from error
    return _robot(file, content, model)


def resolve(name: str | Path, physics: str | None = None) -> Task:
    """The task that a command means: the name of one of Madoc's robots, or the path of a spec file.

    Args:
        name: `hopper`, or `arm.yaml`.
        physics: `legacy` or `modern`; None takes `legacy` for Madoc's robots. Robots of one's own are `modern`.

    Raises:
        MadocError: There is no such robot, or `load` refuses.
    """
    if is_spec_path(name):
        if physics == "legacy":
            raise MadocError(f"legacy physics is that of Madoc's own robots; leave it out for {name}")
        return load(name).task
    if str(name) not in TASKS:
        raise MadocError(
            f"{unknown_name('task', str(name), TASKS)}; or give the path of a robot's spec file, as arm.yaml"
        )
    return tasks.make(str(name), physics or "legacy")


def is_spec_path(name: str | Path) -> bool:
    """Whether a command's robot is given by a file, not by name."""
    return str(name) not in TASKS and (Path(name).suffix.lower() in SUFFIXES or Path(name).expanduser().exists())


def remake(task: Task, physics: str | None = None) -> Task:
    """The same robot with all of its parameters at their normal ranges, as it is before any choice of a run."""
    return tasks.make(task.name, physics or task.physics) if task.source is None else restore(task.source)


def schema() -> dict[str, Any]:
    """JSON schema of the spec file."""
    made = RobotSpec.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **made, "title": "Madoc robot spec"}


def _robot(file: Path, content: bytes, model: ModelFiles) -> Robot:
    spec, document = read_spec(content, file.name)
    source = {"file": file.name, "spec": content.decode("utf-8-sig"), "model": model.to_json()}
    parts: Parts = make_task(spec, document, model, source)
    return Robot(file, spec, parts.task, parts.signals, parts.task.actions, parts.undetermined, parts.notes)


__all__ = [
    "Robot",
    "RobotSpec",
    "Signal",
    "is_spec_path",
    "load",
    "remake",
    "resolve",
    "restore",
    "restore_robot",
    "schema",
]
