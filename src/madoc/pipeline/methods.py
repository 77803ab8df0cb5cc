"""Methods by name, with some of their hyperparameters changed."""

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, fields, is_dataclass, replace
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
        changes: Hyperparameters by name, those of a part of it as `agents.batch`. Text that is JSON (`3`,
            `[256, 256]`, `null`) is read as such.

    Raises:
        MadocError: No such method, no such hyperparameter, or a value of another type.
    """
    if name not in entries:
        raise unknown_name("method", name, entries)
    make = entries[name].make
    default = make()
    types = _types(type(default))
    new: dict[str, Any] = {}
    for changed, value in changes.items():
        if changed not in types:
            raise unknown_name(f"hyperparameter of {name}", changed, types)
        typed = _typed(changed, value, types[changed], name)
        whole, _, part = changed.partition(".")
        new[whole] = replace(new.get(whole, getattr(default, whole)), **{part: typed}) if part else typed
    return make(**new)


def hyperparameters(method: Any) -> dict[str, Any]:
    """Every hyperparameter of a method by name."""
    return asdict(method)


def _types(kind: Any, prefix: str = "") -> dict[str, Any]:
    """The type of each hyperparameter; those of a part of the method are named `part.name`."""
    hints: dict[str, Any] = get_type_hints(kind)
    found: dict[str, Any] = {}
    for row in fields(kind):
        hint = hints[row.name]
        if isinstance(hint, type) and is_dataclass(hint) and not prefix:
            found |= _types(hint, f"{row.name}.")
        else:
            found[prefix + row.name] = hint
    return found


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
