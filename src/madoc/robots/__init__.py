"""Robots that users describe: a spec file and a model, made into a task.

`load` reads a spec file, `resolve` takes the name of a robot or the path of a spec file, `restore` makes a task again
from the content of a run folder. `spec.py` describes the file, and `schema()` is its JSON schema.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from madoc import tasks
from madoc.errors import MadocError, unknown_name
from madoc.robots.functions import PythonFile, require_permission
from madoc.robots.model_files import ModelFiles
from madoc.robots.spec import RobotSpec, read_spec
from madoc.robots.task import Robot, Signal, make_robot
from madoc.runs.files import read_bytes
from madoc.tasks import TASKS, Task

SUFFIXES = (".yaml", ".yml")


def load(path: str | Path, *, allow_code: bool = False, allow_outside: bool = False) -> Robot:
    """Read a spec file and its model. Files whose content has not changed are parsed and compiled once.

    A spec that names a Python file, which is run, needs `allow_code`; a model that names files outside its folder needs
    `allow_outside`.

    Raises:
        MadocError: A file is missing, or the spec has a mistake; the sentence names its line.
        NotAllowed: The spec names a Python file, or the model a file elsewhere, and that is not allowed.
    """
    file = Path(path).expanduser()
    if not file.is_file():
        what = "is a directory" if file.is_dir() else "does not exist"
        raise MadocError(
            f"expected the spec file of a robot, got {file}, which {what}; write one with: madoc init MODEL"
        )
    content = read_bytes(file)
    spec, document = read_spec(content, file.name)
    with document.at("model"):
        model = ModelFiles.read(file.parent / spec.model, allow_outside=allow_outside)
    python = None
    if spec.python is not None:
        names = f"{file.name}, line {document.line(('python',))}: the spec names"
        require_permission(spec.python, names, allowed=allow_code)
        with document.at("python"):
            python = PythonFile.read(file.parent, spec.python)
    return replace(make_robot(content, file.name, model, python), path=file)


def restore(source: Mapping[str, object], *, allow_code: bool = False) -> Robot:
    """The robot that `Task.source` describes, without reading any file.

    Raises:
        MadocError: The source is damaged.
        NotAllowed: The source holds a Python file, and `allow_code` is not given.
    """
    file, spec, model = (source.get(name) for name in ("file", "spec", "model"))
    try:
        if not (isinstance(file, str) and isinstance(spec, str) and isinstance(model, Mapping)):
            raise ValueError("it has no file, spec or model")
        content, files = spec.encode(), ModelFiles.from_json(model)
        python = PythonFile.from_json(source["python"]) if "python" in source else None
    except ValueError as error:
        raise MadocError(f"the robot in this run's spec.json cannot be read: {error}; restore the file") from error
    if python is not None:
        require_permission(python.name, f"this run keeps, with the spec {file},", allowed=allow_code)
    return make_robot(content, file, files, python)


def resolve(
    name: str | Path, physics: str | None = None, *, allow_code: bool = False, allow_outside: bool = False
) -> Task:
    """The task of a robot, given by name, as `hopper`, or by the path of a spec file, as `arm.yaml`; see `load`.

    Physics is `legacy` or `modern`; None takes `legacy` for Madoc's robots. A robot of a spec file is `modern`.

    Raises:
        MadocError: There is no such robot, or `load` refuses its file.
    """
    if is_spec_path(name):
        if physics == "legacy":
            raise MadocError(f"legacy physics exists only for Madoc's own robots; leave it out for {name}")
        return load(name, allow_code=allow_code, allow_outside=allow_outside).task
    if str(name) not in TASKS:
        raise MadocError(
            f"{unknown_name('task', str(name), TASKS)}; or give the path of a robot's spec file, as arm.yaml"
        )
    return tasks.make(str(name), physics or "legacy")


def is_spec_path(name: str | Path) -> bool:
    """Whether a robot is given by the path of a spec file, not by name."""
    return str(name) not in TASKS and (Path(name).suffix.lower() in SUFFIXES or Path(name).expanduser().exists())


def schema() -> dict[str, object]:
    """JSON schema of the spec file."""
    made = RobotSpec.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **made, "title": "Madoc robot spec"}


__all__ = ["Robot", "RobotSpec", "Signal", "is_spec_path", "load", "resolve", "restore", "schema"]
