"""`madoc init` and `madoc spec`, for a user's own robot, and models of robots by name."""

import importlib
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich import box
from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional, arg

from madoc.commands.answer import Answer, Output
from madoc.errors import MadocError, listed, nearest, needing
from madoc.pipeline.orders import Permission

if TYPE_CHECKING:
    from madoc.robots import Robot

_CACHE = "~/.cache/robot_descriptions"
"""Where robot_descriptions keeps what it has fetched, unless ROBOT_DESCRIPTIONS_CACHE names another folder."""
_OTHERS = ("scene", "mjx")
"""Parts of names of files that are a robot's surroundings, or variants of it."""


@dataclass(frozen=True)
class Init:
    """Write the spec file of a robot of your own from its model, with comments that explain every part."""

    model: Annotated[Positional[str], arg(metavar="MODEL")]
    """MJCF or URDF, or the name of a robot that MuJoCo Menagerie has, as go2."""
    out: Path | None = None
    """The spec file. Default: beside the model, as robot.yaml for robot.xml; of a robot by name, go2.yaml here."""
    menagerie: Path | None = None
    """A checkout of MuJoCo Menagerie. Default: the one that robot_descriptions keeps in its cache."""
    download: bool = False
    """Let the package robot_descriptions fetch a robot that is not here, from GitHub."""
    recipe: Annotated[str, arg(metavar="CLASS")] = ""
    """Ranges of what drives of a class of machines are like: hobby-servo, harmonic-arm, direct-drive-leg, dc-gearmotor,
    drone or wheeled. Default: those that follow from the model."""
    allow_outside: bool = False
    """Read files outside the folder of the model that it names, as ../meshes."""
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Write the file."""
        from madoc import robots
        from madoc.robots.init import write_spec

        model = model_of(self.model, menagerie=self.menagerie, download=self.download)
        beside = model.parent if model == Path(self.model).expanduser() else Path()
        out = self.out or beside / f"{model.stem or 'robot'}.yaml"
        write_spec(model, out, allow_outside=self.allow_outside, recipe=self.recipe)
        robot = robots.load(out, allow_outside=self.allow_outside)
        counts = {
            "signals": len(robot.signals),
            "actions": len(robot.actions),
            "parameters": len(robot.spec.parameters),
        }
        parts = [f"{count} {what.removesuffix('s') if count == 1 else what}" for what, count in counts.items()]
        lines = (f"{', '.join(parts)}; edit it, then: madoc spec {out}", f"spec: {out}")
        return Answer({"spec": str(out), "name": robot.spec.name, **counts}, lines)


@dataclass(frozen=True)
class Spec:
    """Check the spec file of a robot of your own, and show what it means."""

    spec: Annotated[Positional[str], arg(metavar="SPEC")] = ""
    """The file, as robot.yaml."""
    schema: bool = False
    """Print the file's JSON schema instead, for editors."""
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Check and describe."""
        from madoc import robots
        from madoc.runs.files import json_text

        if self.schema:
            schema = robots.schema()
            return Answer(schema, (json_text(schema, what="the schema", indent=2),))
        if not self.spec:
            raise MadocError("expected the spec file of a robot, as madoc spec robot.yaml; madoc init MODEL writes one")
        robot = robots.load(self.spec, **vars(self.permission))
        return Answer(describe(robot), (*_tables(robot), *_sentences(robot)))


def describe(robot: "Robot") -> dict[str, object]:
    """The robot of a spec, as JSON."""
    from madoc.simulation.write import nominal_values

    task, model = robot.task, robot.task.model
    return {
        "name": task.name,
        "spec": str(robot.path),
        "model": robot.spec.model,
        "model_files": list(robot.model_files),
        "control_step": robot.spec.control_step,
        "timestep": float(model.opt.timestep),
        "physics_steps": task.frame_skip,
        "pending_actions": task.pending,
        "state_can_be_rebuilt": task.state_from_observation is not None,
        "undetermined": list(robot.undetermined),
        "groups": task.groups,
        "reward": robot.spec.reward,
        "signals": [{"name": row.name, "unit": row.unit, "reads": row.reads} for row in robot.signals],
        "actions": [
            {"name": row.name, "unit": row.unit, "low": row.low, "high": row.high, "actuator": row.actuator}
            | {"control": [row.low * row.scale, row.high * row.scale]}
            for row in robot.actions
        ],
        "parameters": [
            {"name": row.name, "field": row.field, "elements": list(row.elements), "unit": row.unit}
            | {"low": row.low, "high": row.high, "model": list(nominal_values(model, row))}
            for row in task.parameters.parameters
        ],
        "sentences": list(_sentences(robot)),
    }


def _sentences(robot: "Robot") -> list[str]:
    """What a user should know about the robot, one sentence each."""
    task = robot.task
    sentences = [
        f"one action every {robot.spec.control_step:g} s, {task.frame_skip} physics steps each; "
        f"{len(task.parameters)} parameter{'s' * (len(task.parameters) > 1)}"
    ]
    if task.state_from_observation is not None:
        sentences.append("states can be rebuilt from the log: every method can calibrate this robot")
    else:
        missing = ", ".join(robot.undetermined) or "the signals do not tell joints apart"
        willing = "least-squares estimates them, madoc looks at windows of rows, " if task.posture else ""
        sentences.append(
            f"states cannot be rebuilt from the log, as {missing}: {willing}methods that take logged states for true "
            "refuse"
        )
    if task.pending:
        sentences.append(f"a state carries the last {task.pending} action{'s' * (task.pending > 1)}")
    sentences.append(f"a run folder keeps these files of the model: {listed(robot.model_files)}")
    if not task.rewarded:
        sentences.append("no reward: madoc learn refuses this robot until the spec has one")
    return [*sentences, *robot.notes]


def _tables(robot: "Robot") -> tuple[Table, ...]:
    """The signals, actions and parameters of a robot."""
    from madoc.simulation.write import nominal_values

    signals = _table(f"{robot.task.name}: signals", ("name", "unit", "reads"))
    for signal in robot.signals:
        signals.add_row(signal.name, signal.unit, signal.reads)
    actions = _table("actions", ("name", "unit", "low", "high", "actuator", "control"))
    for row in robot.actions:
        control = f"[{row.low * row.scale:g}, {row.high * row.scale:g}]"
        actions.add_row(row.name, row.unit, f"{row.low:g}", f"{row.high:g}", row.actuator, control)
    parameters = _table("parameters", ("name", "unit", "low", "high", "model", "shared by"))
    for parameter in robot.task.parameters.parameters:
        values = dict.fromkeys(f"{value:.4g}" for value in nominal_values(robot.task.model, parameter))
        shared = ", ".join(parameter.elements) if len(parameter.elements) > 1 else ""
        ends = (f"{parameter.low:g}", f"{parameter.high:g}")
        parameters.add_row(parameter.name, parameter.unit, *ends, ", ".join(values), shared)
    return signals, actions, parameters


def _table(title: str, headings: tuple[str, ...]) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in headings:
        table.add_column(heading, justify="right" if heading in ("low", "high", "model") else "left")
    return table


def model_of(name: str, *, menagerie: Path | None = None, download: bool = False) -> Path:
    """The model file of a robot: `name` itself where it is a path, else of the robot of that name.

    It is looked for in a checkout of MuJoCo Menagerie, which is `menagerie` or the one that robot_descriptions has
    fetched before. The network is used only where `download` says so.

    Raises:
        MadocError: There is no such robot, or more than one.
    """
    path = Path(name).expanduser()
    if path.exists() or path.suffix or len(path.parts) != 1:
        return path
    if menagerie is not None and not menagerie.expanduser().is_dir():
        raise MadocError(f"there is no folder {menagerie}; name a checkout of MuJoCo Menagerie with --menagerie")
    cache = Path(os.environ.get("ROBOT_DESCRIPTIONS_CACHE", _CACHE)) / "mujoco_menagerie"
    models = sorted((menagerie or cache).expanduser().glob("*/*.xml"))
    found = [file for file in models if file.stem == name]
    if not found:
        of_robot = [file for file in models if file.parent.name == name]
        found = [file for file in of_robot if not any(word in file.stem for word in _OTHERS)]
    if len(found) == 1:
        return found[0]
    if found:
        raise MadocError(f"{name} may be {listed([str(file) for file in found], 8)}; name the file of one of them")
    if download:
        return _fetched(name)
    known = nearest(name, [file.stem for file in models if not file.stem.startswith(_OTHERS)])
    where = f"; near it are {', '.join(known)}" if known else ""
    raise MadocError(
        f"there is no file {name}, and no robot of that name in {menagerie or cache}{where}; name a model file, a "
        "checkout of MuJoCo Menagerie with --menagerie, or let the package robot_descriptions fetch it with --download"
    )


def _fetched(name: str) -> Path:
    """The model that robot_descriptions fetches by git, MJCF before URDF."""
    with needing("fetching a robot needs the package robot_descriptions;", "madoc-calibration[robots]"):
        known = importlib.import_module("robot_descriptions._descriptions").DESCRIPTIONS
    for kind, path in (("mj_description", "MJCF_PATH"), ("description", "URDF_PATH")):
        if f"{name}_{kind}" in known:
            try:
                return Path(getattr(importlib.import_module(f"robot_descriptions.{name}_{kind}"), path))
            except Exception as error:  # git raises what it likes where there is no network
                reason = " ".join(str(error).split())[:200]
                raise MadocError(f"could not fetch {name} ({reason}); is there a network, and git?") from error
    names = [key.removesuffix("_description").removesuffix("_mj") for key in known]
    raise MadocError(f"robot_descriptions has no robot {name}; near it are {', '.join(nearest(name, names)) or 'none'}")
