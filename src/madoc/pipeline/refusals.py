"""What is refused of an order before its data is read, and the random keys of its seed.

Stages, `madoc run` and suites ask the same here; an error says which option it is about.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import get_args

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from madoc.calibration import CALIBRATORS
from madoc.data.dataset import check_share
from madoc.data.disturbance import Disturbance
from madoc.data.formats import check_format
from madoc.errors import MadocError, about, unknown_name
from madoc.pipeline.methods import learner_of, methods_for
from madoc.pipeline.orders import AUTO, CalibrationOrder, Drawing, Place, PolicyOrder, Search, Source
from madoc.policies import LEARNERS, require_reward
from madoc.runs.budget import read_budget
from madoc.runs.files import read_json
from madoc.tasks import Task
from madoc.types import MethodEntry, named_key

LARGEST_SEED = 2**32 - 1
"""Largest seed: `jax.random.key` takes 32 bits."""


def check_calibration(order: CalibrationOrder, task: Task) -> None:
    """Refuse a calibration of a robot by an unknown method, with impossible numbers, or with a truth that does not fit.

    Raises:
        MadocError: Names the option.
    """
    search, rows = order.search, order.source.max_transitions
    with about("level" if search.parameters is None else "parameters"):
        _check_search(search, task, Path(order.task).name)
    with about("set" if order.method in (AUTO, *CALIBRATORS) else "method"):
        methods_for(order.method, search.set)
    check_seed(search.seed)
    if search.budget is not None:
        with about("budget"):
            read_budget(search.budget)
    if order.holdout is not None:
        with about("holdout"):
            check_share(order.holdout)
    with about("format"):
        check_format(order.source.reading.format)
    if rows is not None and rows < 1:
        raise MadocError(f"expected max_transitions of 1 or more, got {rows}", option="max_transitions")
    truth_of(order.truth, task, search.parameters)


def check_policy(order: PolicyOrder, task: Task, *, written: str = "--{}") -> None:
    """Refuse a policy that cannot be learnt for a robot, whose options are `written` so where they are given.

    Raises:
        MadocError: Names the option.
    """
    with about("set" if order.method in LEARNERS else "method"):
        _, learner = learner_of(order.method, order.set)
    with about("budget"):
        read_budget(learner.usual_budget if order.budget is None else order.budget, learner.unit)
    share, width, at = (written.format(name) for name in ("share", "width", "at"))
    places = get_args(Place)
    if order.at not in places:
        with about("at"):
            raise unknown_name("place to learn at", order.at, places)
    if order.at != "calibrated" and not learner.needs_parameters:
        does_not = f"{learner.name} does not learn at given parameters"
        raise MadocError(f"{does_not}, so {at} {order.at} would change nothing; leave it out", option="at")
    if order.at != "distribution" and order.drawing != Drawing():
        raise MadocError(
            f"{share} and {width} are of {at} distribution and would change nothing at {order.at}; leave them out",
            option="share" if order.drawing.share != Drawing.share else "width",
        )
    with about(""):
        require_reward(task)
    goals = task.for_policies.goals
    if goals and learner.needs_data:
        raise MadocError(
            f"{learner.name} learns from logged observations, and no log has the goals of {task.name}: "
            f"{', '.join(goals)}; take a learner that needs no data",
            option="method",
        )
    check_seed(order.seed)


def check_folder(out: Path, source: Source) -> None:
    """Refuse a run folder that holds the logs.

    Raises:
        MadocError: Names the log.
    """
    folder = out.expanduser().resolve()
    for path in source.paths:
        log = Path(path).expanduser().resolve()
        if log == folder or (log.exists() and log.is_relative_to(folder) and not (folder / "spec.json").exists()):
            raise MadocError(f"the run folder {out} holds the log {path}; choose another --out")


def check_counts(**counts: int) -> None:
    """Refuse counts below 1; each is given by the name of what it counts, and its option is the plural of that.

    Raises:
        MadocError: Names what is counted.
    """
    for what, count in counts.items():
        if count < 1:
            raise MadocError(f"expected at least 1 {what}, got {count}", option=f"{what}s")


def require_velocities(learner: MethodEntry[object], disturbance: Disturbance, log: str) -> None:
    """Raise MadocError for a learner that learns from logged data where the velocities of that are hidden."""
    if disturbance.hidden_velocities and learner.needs_data:
        raise MadocError(
            f"{learner.name} learns from whole observations, and {log} hides velocities; "
            "take a method that needs no data",
            option="method",
        )


def _check_search(search: Search, task: Task, name: str) -> None:
    """Refuse parameters that the robot does not have, one named twice, none at all, and ranges of an unknown level.

    The name is what the order calls the robot.
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


def truth_of(
    file: Path | None, task: Task, calibrated: Iterable[str] | None = None, *, known: Mapping[str, float] | None = None
) -> dict[str, float] | None:
    """The true parameters of a robot from a JSON file `{name: value}`; without a file those that are `known`, if any.

    Raises:
        MadocError: The file is missing or no JSON, or holds anything but finite numbers by name; or a parameter that is
            calibrated is not among them, of all by default, or one is that the robot does not have.
    """
    with about("truth"):
        truth = known if file is None else _read_truth(file)
        if truth is None:
            return None
        names = task.parameters.names
        for name in truth:
            if name not in names:
                raise unknown_name(f"parameter of {task.name} in the truth", name, names)
        missing = [name for name in (names if calibrated is None else calibrated) if name not in truth]
        if missing:
            raise MadocError(f"the truth has no value for {missing[0]}; add it, or do not calibrate that")
        return {name: float(value) for name, value in truth.items()}


def _read_truth(path: Path) -> Mapping[str, float]:
    """Finite numbers by name."""
    values = read_json(path)
    if not isinstance(values, dict) or not values:
        raise MadocError(f'expected {{"parameter": value, ...}} in {path}, got {type(values).__name__}')
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise MadocError(f"expected a finite number for {name} in {path}, got {value!r}")
    return values


def check_seed(seed: int) -> None:
    """Refuse a seed that is negative or too large."""
    if not 0 <= seed <= LARGEST_SEED:
        raise MadocError(f"expected a seed from 0 to {LARGEST_SEED}, got {seed}", option="seed")


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
