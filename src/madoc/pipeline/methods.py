"""Methods by name, with some of their hyperparameters changed."""

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from typing import Any, NoReturn, Protocol, get_type_hints

from pydantic import TypeAdapter, ValidationError

from madoc.errors import MadocError, unknown_name


class Entry(Protocol):
    """A line of a registry of methods."""

    @property
    def make(self) -> Callable[..., Any]:
        """Takes hyperparameters as keywords."""
        ...


def make_method(entries: Mapping[str, Entry], name: str, changes: Mapping[str, Any]) -> Any:
    """A method of a registry.

    Args:
        entries: `CALIBRATORS` or `LEARNERS`.
        name: One of its keys.
        changes: Hyperparameters by name. Text that is JSON (`3`, `[256, 256]`, `null`) is read as such.

    Raises:
        MadocError: No such method, no such hyperparameter, or a value of another type.
    """
    if name not in entries:
        raise unknown_name("method", name, entries)
    make = entries[name].make
    kind = type(make())
    types = get_type_hints(kind)
    known = [field.name for field in fields(kind) if field.init]
    for changed in changes:
        if changed not in known:
            raise unknown_name(f"hyperparameter of {name}", changed, known)
    return make(**{key: _typed(key, value, types[key], name) for key, value in changes.items()})


def hyperparameters(method: Any) -> dict[str, Any]:
    """Every hyperparameter of a method by name."""
    return {field.name: getattr(method, field.name) for field in fields(method) if field.init}


def parse_settings(settings: Iterable[str]) -> dict[str, str]:
    """`["updates=2", "hidden=[64,64]"]` as a dictionary of texts.

    Raises:
        MadocError: One is not `name=value`, or a name comes twice.
    """
    found: dict[str, str] = {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        name = name.strip().replace("-", "_")
        if not equals or not name:
            raise MadocError(f"expected hyperparameters as name=value, got {setting!r}")
        if name in found:
            raise MadocError(f"hyperparameter {name} is given twice: {found[name]!r} and {value!r}")
        found[name] = value
    return found


def _typed(name: str, value: Any, hint: Any, method: str) -> Any:
    """A value as the type a hyperparameter has."""
    refusal: ValidationError | None = None
    for candidate in _readings(value):
        try:
            typed = TypeAdapter(hint).validate_python(candidate)
        except ValidationError as error:
            refusal = refusal or error
            continue
        if isinstance(typed, float) and not math.isfinite(typed):
            raise MadocError(f"hyperparameter {name} of {method} must be finite, got {value!r}")
        return typed
    what = str(hint).removeprefix("typing.") if not isinstance(hint, type) else hint.__name__
    raise MadocError(f"hyperparameter {name} of {method} is {what}, got {value!r}") from refusal


def _readings(value: Any) -> list[Any]:
    """What a text may mean: the JSON it is, else itself. Other values mean themselves."""
    if not isinstance(value, str):
        return [value]
    try:
        return [json.loads(value, parse_constant=_no_constant), value]
    except ValueError:
        return [value]


def _no_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a finite number")
