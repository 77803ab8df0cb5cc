"""What is refused of an order before its data is read."""

from pathlib import Path

from madoc import robots
from madoc.errors import MadocError, unknown_name
from madoc.pipeline.keys import check_seed
from madoc.pipeline.orders import AUTO, CalibrationOrder, Search
from madoc.runs.budget import read_budget
from madoc.tasks import Task


def method_of(order: CalibrationOrder) -> str:
    """The calibrator of an order; by default `auto` for a user's own robot, else `madoc`."""
    return order.search.method or (AUTO if robots.is_spec_path(order.task) else "madoc")


def check_order(order: CalibrationOrder, out: Path | None = None) -> None:
    """Refuse what can be refused without reading the data, such as a run folder `out` that holds the logs.

    Raises:
        MadocError: The seed, the budget or the share held out is impossible, or the folder holds the logs.
    """
    check_seed(order.search.seed)
    if order.search.budget is not None:
        read_budget(order.search.budget)
    if order.holdout is not None and not 0.0 < order.holdout < 1.0:
        raise MadocError(f"expected a share of the rows to hold out between 0 and 1, got {order.holdout}")
    if out is None:
        return
    folder = out.expanduser().resolve()
    for path in order.source.paths:
        log = Path(path).expanduser().resolve()
        if log == folder or (log.exists() and log.is_relative_to(folder) and not (folder / "spec.json").exists()):
            raise MadocError(f"the run folder {out} holds the log {path}; choose another --out")


def check_search(search: Search, task: Task, name: str) -> None:
    """Refuse parameters that the robot does not have, one named twice, none at all, and ranges of an unknown level.

    Args:
        search: What is calibrated.
        task: The robot.
        name: What the order calls it, for the sentence.

    Raises:
        MadocError: Names the parameter or the level.
    """
    named = task.parameters.names if search.parameters is None else search.parameters
    if not named:
        raise MadocError("expected the names of parameters to calibrate, got none; leave it out to calibrate all")
    for parameter in named:
        if parameter not in task.parameters.names:
            raise unknown_name(f"parameter of {name}", parameter, task.parameters.names)
        if named.count(parameter) > 1:
            raise MadocError(f"the parameter {parameter} is named twice; keep one")
    task.with_level(search.level)
