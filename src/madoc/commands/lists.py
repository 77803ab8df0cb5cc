"""`madoc tasks` and `madoc methods`."""

from dataclasses import dataclass, field
from typing import Any

from rich.console import RenderableType
from rich.table import Table
from tyro.conf import OmitArgPrefixes

from madoc.commands.answer import Answer, Output

PHYSICS = ("legacy", "modern")


@dataclass(frozen=True)
class Tasks:
    """List the robots."""

    verbose: bool = False
    """Also list their parameters, with ranges and units."""
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """The robots, as a table."""
        from madoc.tasks import TASKS, make

        rows = [_task_row(make(name)) for name in TASKS]
        table = Table(title="robots", title_justify="left")
        table.add_column("name")
        for heading in ("observations", "motors", "parameters", "groups"):
            table.add_column(heading, justify="right")
        table.add_column("physics")
        for row in rows:
            cells = (row["observations"], row["motors"], len(row["parameters"]), row["groups"])
            table.add_row(row["name"], *map(str, cells), ", ".join(PHYSICS))
        details: tuple[RenderableType, ...] = tuple(map(_parameter_table, rows)) if self.verbose else ()
        return Answer({"tasks": rows}, (table, *details))


@dataclass(frozen=True)
class Methods:
    """List the calibrators and the policy learners."""

    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """The methods, one line each."""
        from madoc.calibration import CALIBRATORS
        from madoc.policies import LEARNERS

        kinds = (("calibrator", CALIBRATORS), ("policy learner", LEARNERS))
        rows = [
            {"name": name, "kind": kind, "summary": entry.summary, "paper": entry.paper, "year": entry.year}
            | {"budget": entry.unit}
            for kind, entries in kinds
            for name, entry in entries.items()
        ]
        return Answer({"methods": rows}, tuple(_methods_table(kind, rows) for kind, _ in kinds))


def _methods_table(kind: str, rows: list[dict[str, Any]]) -> Table:
    """The methods of one kind; what their budgets count is in the title where all count the same."""
    own = [row for row in rows if row["kind"] == kind]
    units = {row["budget"] for row in own}
    columns = ["name", "summary", "paper", "year", *(["budget"] if len(units) > 1 else [])]
    told = "" if len(units) > 1 else f", budgets in {units.pop()}"
    table = Table(title=f"{kind}s{told}", title_justify="left")
    for heading in columns:
        table.add_column(heading, no_wrap=heading in ("name", "year", "budget"))
    for row in own:
        table.add_row(*(str(row[column]) for column in columns))
    return table


def _task_row(task: Any) -> dict[str, Any]:
    """A robot as JSON."""
    levels = {level: space.parameters for level, space in task.ranges.items()}
    return {
        "name": task.name,
        "observations": task.observation_size,
        "motors": task.action_size,
        "groups": task.groups,
        "physics": list(PHYSICS),
        "parameters": [
            {
                "name": parameter.name,
                "unit": parameter.unit,
                "ranges": {level: [rows[index].low, rows[index].high] for level, rows in levels.items()},
            }
            for index, parameter in enumerate(task.parameters.parameters)
        ],
    }


def _parameter_table(row: dict[str, Any]) -> Table:
    """The parameters of one robot."""
    levels = list(row["parameters"][0]["ranges"])
    table = Table(title=row["name"], title_justify="left")
    table.add_column("parameter")
    table.add_column("unit")
    for level in levels:
        table.add_column(level, justify="right")
    for parameter in row["parameters"]:
        ranges = [f"[{low:g}, {high:g}]" for low, high in parameter["ranges"].values()]
        table.add_row(parameter["name"], parameter["unit"], *ranges)
    return table
