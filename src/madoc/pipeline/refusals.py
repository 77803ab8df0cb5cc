"""What is refused of an order before its data is read, and the random keys of its seed."""

from pathlib import Path

import jax
from jaxtyping import PRNGKeyArray

from madoc.data.dataset import check_share
from madoc.data.disturbance import Disturbance
from madoc.errors import MadocError, unknown_name
from madoc.pipeline.orders import AUTO, CalibrationOrder, Drawing, Search
from madoc.policies import LEARNERS
from madoc.runs.budget import Budget, read_budget
from madoc.tasks import Task
from madoc.types import named_key

LARGEST_SEED = 2**32 - 1
"""Largest seed: `jax.random.key` takes 32 bits."""


def method_of(order: CalibrationOrder) -> str:
    """The calibrator of an order, `auto` by default."""
    return order.search.method or AUTO


def check_order(order: CalibrationOrder, out: Path | None = None) -> None:
    """Refuse what can be refused without reading the data, such as a run folder `out` that holds the logs.

    Raises:
        MadocError: The seed, the budget or the share held out is impossible, or the folder holds the logs.
    """
    check_seed(order.search.seed)
    if order.search.budget is not None:
        read_budget(order.search.budget)
    if order.holdout is not None:
        check_share(order.holdout)
    if out is None:
        return
    folder = out.expanduser().resolve()
    for path in order.source.paths:
        log = Path(path).expanduser().resolve()
        if log == folder or (log.exists() and log.is_relative_to(folder) and not (folder / "spec.json").exists()):
            raise MadocError(f"the run folder {out} holds the log {path}; choose another --out")


def check_counts(**counts: int) -> None:
    """Refuse counts below 1; each is given by the name of what it counts.

    Raises:
        MadocError: Names what is counted.
    """
    for what, count in counts.items():
        if count < 1:
            raise MadocError(f"expected at least 1 {what}, got {count}")


def policy_budget(method: str, given: Budget | str | None) -> Budget:
    """The budget of a policy learner, in its unit: what it usually has, where none is given.

    Raises:
        MadocError: It is no budget, or not positive.
    """
    entry = LEARNERS[method]
    return read_budget(entry.usual_budget if given is None else given, entry.unit)


def check_place(method: str, at: str, written: str) -> None:
    """Refuse a place to learn at, as `written` in the order, of a learner that does not learn at given parameters.

    Raises:
        MadocError: Names the learner and the place.
    """
    if at != "calibrated" and not LEARNERS[method].needs_parameters:
        raise MadocError(
            f"{method} does not learn at given parameters, so {written} would change nothing; leave it out"
        )


def check_drawing(drawing: Drawing, at: str, written: str) -> None:
    """Refuse a way to draw systems where none are drawn; `written` says in the order's words where they are.

    Raises:
        MadocError: Names the options.
    """
    if at != "distribution" and drawing != Drawing():
        raise MadocError(f"{written} and would change nothing at {at}; leave them out")


def require_no_goals(task: Task, method: str) -> None:
    """Raise MadocError for a learner that learns from logged data where policies observe goals, which no log has."""
    goals = task.for_policies.goals
    if goals and LEARNERS[method].needs_data:
        raise MadocError(
            f"{method} learns from logged observations, and no log has the goals of {task.name}: {', '.join(goals)}; "
            "take a learner that needs no data"
        )


def require_velocities(method: str, disturbance: Disturbance, log: str) -> None:
    """Raise MadocError for a learner that learns from logged data where the velocities of that are hidden."""
    if disturbance.hidden_velocities and LEARNERS[method].needs_data:
        raise MadocError(
            f"{method} learns from whole observations, and {log} hides velocities; take a method that needs no data"
        )


def check_search(search: Search, task: Task, name: str) -> None:
    """Refuse parameters that the robot does not have, one named twice, none at all, and ranges of an unknown level.

    The name is what the order calls the robot.

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


def check_seed(seed: int) -> None:
    """Refuse a seed that is negative or too large."""
    if not 0 <= seed <= LARGEST_SEED:
        raise MadocError(f"expected a seed from 0 to {LARGEST_SEED}, got {seed}")


def seed_key(seed: int) -> PRNGKeyArray:
    """The random key of a seed, which calibrations use as it is: their results name the seed.

    Raises:
        MadocError: The seed is negative or too large.
    """
    check_seed(seed)
    return jax.random.key(seed)


def stage_key(seed: int, stage: str) -> PRNGKeyArray:
    """The random key of a stage by its name, the same within `madoc run` as alone."""
    return named_key(seed_key(seed), stage)
