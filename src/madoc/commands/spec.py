"""`madoc init` and `madoc spec`: a robot of one's own."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich import box
from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional, arg

from madoc.commands.answer import Answer, Output, left_behind
from madoc.errors import MadocError

if TYPE_CHECKING:
    from madoc.robots import Robot


@dataclass(frozen=True)
class Init:
    """Write the spec file of a robot of your own from its model, with comments that explain every part."""

    model: Annotated[Positional[Path], arg(metavar="MODEL")]
    """MJCF or URDF."""
    out: Path | None = None
    """The spec file. Default: beside the model, as robot.yaml for robot.xml."""
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Write the file."""
        from madoc import robots
        from madoc.robots.init import write_spec

        out = self.out or self.model.with_suffix(".yaml")
        write_spec(self.model, out)
        robot = robots.load(out)
        counts = {
            "signals": len(robot.signals),
            "actions": len(robot.actions),
            "parameters": len(robot.spec.parameters),
        }
        told = ", ".join(f"{count} {what.removesuffix('s') if count == 1 else what}" for what, count in counts.items())
        lines = (f"{told}; edit it, then: madoc spec {out}", left_behind(out, "spec"))
        return Answer({"spec": str(out), "name": robot.spec.name, **counts}, lines)


@dataclass(frozen=True)
class Spec:
    """Check the spec file of a robot of your own, and show what it means."""

    spec: Annotated[Positional[str], arg(metavar="SPEC")] = ""
    """The file, as robot.yaml."""
    schema: bool = False
    """Print the file's JSON schema instead, for editors."""
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
        described = describe(robots.load(self.spec))
        return Answer(described, (*_tables(described), *described["sentences"]))


def describe(robot: "Robot") -> dict[str, Any]:
    """What a spec means, as JSON."""
    from madoc.simulation.write import nominal_values

    task, model = robot.task, robot.task.compile()
    return {
        "name": task.name,
        "spec": str(robot.path),
        "model": robot.spec.model,
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
    task = robot.task
    said = [
        f"one action every {robot.spec.control_step:g} s, {task.frame_skip} physics steps each; "
        f"{len(task.parameters)} parameters in {task.groups} group{'s' * (task.groups > 1)}"
    ]
    if task.state_from_observation is not None:
        said.append("states can be rebuilt from the log: every method can calibrate this robot")
    else:
        missing = ", ".join(robot.undetermined) or "the signals do not tell joints apart"
        willing = "least-squares estimates them, madoc looks at windows of rows, " if task.posture else ""
        said.append(
            f"states cannot be rebuilt from the log, as {missing}: {willing}methods that take logged states for true "
            "refuse"
        )
    if task.pending:
        said.append(f"a state carries the last {task.pending} action{'s' * (task.pending > 1)}")
    if not task.rewarded:
        said.append("no reward: madoc learn refuses this robot until the spec has one")
    return [*said, *robot.notes]


def _tables(described: dict[str, Any]) -> tuple[Table, ...]:
    signals = _table(f"{described['name']}: signals", ("name", "unit", "reads"))
    for row in described["signals"]:
        signals.add_row(row["name"], row["unit"], row["reads"])
    actions = _table("actions", ("name", "unit", "low", "high", "actuator", "control"))
    for row in described["actions"]:
        low, high = row["control"]
        ends = (f"{row['low']:g}", f"{row['high']:g}")
        actions.add_row(row["name"], row["unit"], *ends, row["actuator"], f"[{low:g}, {high:g}]")
    parameters = _table("parameters", ("name", "unit", "low", "high", "model", "shared by"))
    for row in described["parameters"]:
        values = ", ".join(dict.fromkeys(f"{value:.4g}" for value in row["model"]))
        shared = ", ".join(row["elements"]) if len(row["elements"]) > 1 else ""
        parameters.add_row(row["name"], row["unit"], f"{row['low']:g}", f"{row['high']:g}", values, shared)
    return signals, actions, parameters


def _table(title: str, headings: tuple[str, ...]) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in headings:
        table.add_column(heading, justify="right" if heading in ("low", "high", "model") else "left")
    return table
