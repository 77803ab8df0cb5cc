"""Methods by name, with changes to their hyperparameters."""

import math
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass, replace
from functools import cache, partial
from typing import Any, TypeVar, get_type_hints

from jaxtyping import PRNGKeyArray
from pydantic import TypeAdapter, ValidationError

from madoc.calibration import CALIBRATORS, CalibrationProblem, Calibrator
from madoc.errors import MadocError, unknown_name
from madoc.pipeline.orders import AUTO, Settings, parse_settings
from madoc.policies import LEARNERS, PolicyLearner
from madoc.types import MethodEntry, entry_of

Made = TypeVar("Made")

CANDIDATES = ("least-squares", "npe")
"""The methods of which `auto` takes the first that does not refuse the data."""


def make_method(
    entries: Mapping[str, MethodEntry[Made]], name: str, changes: Mapping[str, object] | None = None
) -> Made:
    """A method of `CALIBRATORS` or `LEARNERS`, with hyperparameters changed, those of a part of it as `agents.batch`.

    Text that is JSON (`3`, `[256, 256]`, `null`) is read as such.

    Raises:
        MadocError: No such method, no such hyperparameter, or a value of another type.
    """
    if name not in entries:
        raise unknown_name("method", name, entries)
    make = entries[name].make
    default = make()
    types = _types(type(default))
    new: dict[str, object] = {}
    for changed, value in (changes or {}).items():
        if changed not in types:
            raise unknown_name(f"hyperparameter of {name}", changed, types)
        typed = _typed(changed, value, types[changed], name)
        whole, _, part = changed.partition(".")
        new[whole] = replace(new.get(whole, getattr(default, whole)), **{part: typed}) if part else typed  # type: ignore[type-var]
    return make(**new)


@cache  # cells of a suite mostly differ in other things
def learner_of(name: str, settings: Settings) -> tuple[PolicyLearner[Any], MethodEntry[Any]]:
    """A policy learner with its settings, and the entry of what it then is: `sac` that is told to randomize is `dr`."""
    learner = make_method(LEARNERS, name, parse_settings(settings))
    return learner, entry_of(learner, LEARNERS)


def candidates_for(changes: Mapping[str, object]) -> dict[str, Calibrator[Any]]:
    """The methods that `auto` may take, by name; a hyperparameter is changed under a name such as `npe.updates`.

    Raises:
        MadocError: A hyperparameter is named otherwise, or as `make_method`.
    """
    changed: dict[str, dict[str, object]] = {name: {} for name in CANDIDATES}
    for setting, value in changes.items():
        whole, _, part = setting.partition(".")
        name = whole.replace("_", "-")
        if name not in changed or not part:
            raise unknown_name("hyperparameter of auto", setting, [f"{candidate}.NAME" for candidate in CANDIDATES])
        changed[name][part] = value
    return {name: make_method(CALIBRATORS, name, changed[name]) for name in CANDIDATES}


@cache
def methods_for(name: str, settings: Settings) -> Mapping[str, Calibrator[Any]]:
    """The calibrators that a name stands for: one, or those that `auto` may take.

    Raises:
        MadocError: As `make_method` or `candidates_for`.
    """
    changes = parse_settings(settings)
    return candidates_for(changes) if name == AUTO else {name: make_method(CALIBRATORS, name, changes)}


def choose(
    methods: Mapping[str, Calibrator[Any]], problem: CalibrationProblem, key: PRNGKeyArray
) -> tuple[str, str | None]:
    """The name of the first method that takes the problem, and why the ones before it refuse; None for the only one.

    Raises:
        MadocError: Every method refuses it.
    """
    if len(methods) == 1:
        return next(iter(methods)), None
    refusals = []
    for name, method in methods.items():
        try:
            method.init(problem, key)
        except MadocError as error:
            refusals.append(f"{name} refuses: {error}")
            continue
        had = problem.states.kind == "exact"
        states = f"the robot's states can be {'had from' if had else 'fitted to'} the log"
        why = "; ".join(refusals) or states
        return name, f"auto took {name}: {why}"
    raise MadocError("; ".join(refusals))


def hyperparameters(method: object) -> dict[str, object]:
    """Every hyperparameter of a method by name."""
    return asdict(method)  # type: ignore[call-overload]


def _types(kind: type, prefix: str = "") -> dict[str, Any]:
    """The type of each hyperparameter; those of a part of the method are named `part.name`."""
    hints = get_type_hints(kind)
    types: dict[str, Any] = {}
    for row in fields(kind):
        hint = hints[row.name]
        if isinstance(hint, type) and is_dataclass(hint) and not prefix:
            types |= _types(hint, f"{row.name}.")
        else:
            types[prefix + row.name] = hint
    return types


def _typed(name: str, value: object, hint: Any, method: str) -> object:
    """A value as the type that a hyperparameter has; text is read as JSON, or else as itself."""
    adapter = TypeAdapter(hint)
    readings = [partial(adapter.validate_python, value)]
    if isinstance(value, str):
        readings.insert(0, partial(adapter.validate_json, value))
    refusal: ValidationError | None = None
    for read in readings:
        try:
            typed: object = read()
        except ValidationError as error:
            refusal = error
            continue
        if isinstance(typed, float) and not math.isfinite(typed):
            raise MadocError(f"hyperparameter {name} of {method} must be finite, got {value!r}")
        return typed
    what = hint.__name__ if isinstance(hint, type) else str(hint).removeprefix("typing.")
    raise MadocError(f"hyperparameter {name} of {method} is {what}, got {value!r}") from refusal
