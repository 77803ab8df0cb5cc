"""`madoc tasks` and `madoc methods`."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, get_args

from rich.table import Table
from tyro.conf import OmitArgPrefixes

from madoc.commands.answer import Answer, Output, table_of
from madoc.pipeline.orders import Physics

if TYPE_CHECKING:
    from madoc.tasks import Task
    from madoc.types import MethodEntry


@dataclass(frozen=True)
class Tasks:
    """List the robots."""

    verbose: bool = False
    """Also list their parameters, with ranges and units."""
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """The robots, as a table."""
        from madoc.tasks import TASKS, make

        tasks = [make(name) for name in TASKS]
        table = table_of("robots", ["name"], ("observations", "motors", "parameters"))
        table.add_column("physics")
        for task in tasks:
            counts = (task.observation_size, task.action_size, len(task.parameters))
            table.add_row(task.name, *map(str, counts), ", ".join(get_args(Physics)))
        details = tuple(map(_parameter_table, tasks)) if self.verbose else ()
        return Answer({"tasks": [_described(task) for task in tasks]}, (table, *details))


@dataclass(frozen=True)
class Methods:
    """List the calibrators and the policy learners."""

    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """The methods, one line each."""
        from madoc.calibration import CALIBRATORS
        from madoc.policies import LEARNERS

        kinds: dict[str, Mapping[str, MethodEntry[Any]]] = {"calibrator": CALIBRATORS, "policy learner": LEARNERS}
        rows = [
            {"name": name, "kind": kind, "summary": entry.summary, "paper": entry.paper, "year": entry.year}
            | {"budget": entry.unit}
            for kind, entries in kinds.items()
            for name, entry in entries.items()
        ]
        return Answer({"methods": rows}, tuple(_methods_table(kind, entries) for kind, entries in kinds.items()))


def _methods_table(kind: str, entries: "Mapping[str, MethodEntry[Any]]") -> Table:
    """The methods of one kind; the unit of their budgets is in the title where all have the same."""
    units = {entry.unit for entry in entries.values()}
    columns = ["summary", "paper", "year", *(["unit"] if len(units) > 1 else [])]
    ending = "" if len(units) > 1 else f", budgets in {units.pop()}"
    table = table_of(f"{kind}s{ending}", ())
    for column in ["name", *columns]:
        heading = "budget" if column == "unit" else column
        table.add_column(heading, no_wrap=column in ("name", "year", "unit"))
    for name, entry in entries.items():
        table.add_row(name, *(str(getattr(entry, column)) for column in columns))
    return table


def _described(task: "Task") -> dict[str, object]:
    """A robot as JSON."""
    levels = {level: space.parameters for level, space in task.ranges.items()}
    return {
        "name": task.name,
        "observations": task.observation_size,
        "motors": task.action_size,
        "groups": task.groups,
        "physics": list(get_args(Physics)),
        "parameters": [
            {
                "name": parameter.name,
                "unit": parameter.unit,
                "ranges": {level: [rows[index].low, rows[index].high] for level, rows in levels.items()},
            }
            for index, parameter in enumerate(task.parameters.parameters)
        ],
    }


def _parameter_table(task: "Task") -> Table:
    """The parameters of one robot, with their ranges at every level."""
    table = table_of(task.name, ("parameter", "unit"), list(task.ranges))
    for index, parameter in enumerate(task.parameters.parameters):
        rows = [space.parameters[index] for space in task.ranges.values()]
        table.add_row(parameter.name, parameter.unit, *(f"[{row.low:g}, {row.high:g}]" for row in rows))
    return table
