"""The options of an order as keys of a suite file: the names that the command line has, underscores for hyphens."""

import dataclasses
import functools
import json
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

from pydantic import TypeAdapter, ValidationError
from tyro.conf import Suppress

from madoc.errors import MadocError, nearest_hint
from madoc.pipeline.orders import CalibrationOrder, EvaluationOrder, PolicyOrder, RecordOrder
from madoc.robots.document import mistake, shown
from madoc.suites.grid import RANGE

Order = RecordOrder | CalibrationOrder | PolicyOrder | EvaluationOrder
Kind = TypeVar("Kind", RecordOrder, CalibrationOrder, PolicyOrder, EvaluationOrder)
Path = tuple[str, ...]

_SUPPRESSED = get_args(Suppress[int])[1:]
_SETTINGS = "set"
"""Key of hyperparameters, which are `name=value` on the command line and keys and values in a file."""
_LISTS = {"data": "a path or a list of paths", "parameters": "a name or a list of names"}
"""Keys whose value is a list, or a single text for a list of one, and that in words."""


class Misfit(MadocError):
    """A value that an order refuses, and the key that it stands under."""

    def __init__(self, key: str, sentence: str) -> None:
        super().__init__(sentence)
        self.key = key


@functools.cache
def keys_of(order: Any) -> Mapping[str, Path]:
    """Every key of an order, and where its value is in it; the keys of its parts stand beside its own."""
    hints = get_type_hints(order, include_extras=True)
    nested: dict[str, Any] = {}
    keys: dict[str, Path] = {}
    kind: Any
    for row in dataclasses.fields(order):
        kind, metadata = _bare(hints[row.name])
        if any(mark in metadata for mark in _SUPPRESSED):
            continue
        if dataclasses.is_dataclass(kind):
            nested[row.name] = kind
            continue
        named = next((mark.name for mark in metadata if getattr(mark, "name", None)), row.name)
        keys[named.replace("-", "_")] = (row.name,)
    for name, part in nested.items():
        for key, path in keys_of(part).items():
            keys.setdefault(key, (name, *path))
    return keys


def build(order: type[Kind], given: Mapping[str, object]) -> Kind:
    """An order from the keys of a suite file; no value is converted into another type.

    Raises:
        Misfit: A key is unknown or missing, or a value is refused.
    """
    kind: Any = order  # mypy does not see that a dataclass itself can be hashed
    keys = keys_of(kind)
    nested: dict[str, Any] = {}
    for key, value in given.items():
        if key not in keys:
            raise Misfit(key, f"unknown key {key!r}; {nearest_hint(key, keys)}")
        *parts, last = keys[key]
        place = nested
        for part in parts:
            place = place.setdefault(part, {})
        place[last] = _settings(value) if key == _SETTINGS else _listed(key, value)
    try:
        return adapter(kind).validate_json(json.dumps(nested), strict=True)
    except ValidationError as error:
        detail = error.errors()[0]
        key = _key_at(keys, tuple(part for part in detail["loc"] if isinstance(part, str)))
        raise Misfit(key, mistake(detail, (key,), list(keys)) + _grid_hint(key, given.get(key))) from error


@functools.cache
def adapter(order: Any) -> TypeAdapter:  # type: ignore[type-arg]  # beartype knows no TypeAdapter[...]
    """What reads and writes an order as JSON."""
    return TypeAdapter(order)


def stored(order: Order) -> dict[str, Any]:
    """An order as JSON, without what it leaves at its default."""
    kind: Any = type(order)
    return adapter(kind).dump_python(order, mode="json", exclude_defaults=True)


def flat(order: Any, told: Mapping[str, Any]) -> dict[str, Any]:
    """An order that was written by `stored`, as the keys of a suite file with their values."""
    values: dict[str, Any] = {}
    for key, path in keys_of(order).items():
        part: Any = told
        for name in path:
            part = part.get(name) if isinstance(part, Mapping) else None
        if part is not None:
            values[key] = part
    return values


def _bare(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type without its annotations, and these."""
    return (get_args(hint)[0], get_args(hint)[1:]) if get_origin(hint) is Annotated else (hint, ())


def _listed(key: str, value: object) -> object:
    """A single text of a key that takes several as a list of one."""
    if key not in _LISTS or isinstance(value, list):
        return value
    if not isinstance(value, str):
        raise Misfit(key, f"expected {_LISTS[key]} in {key}, got {shown(value)}")
    return [value]


def _grid_hint(key: str, value: object) -> str:
    """Where several values of one key are written, after the refusal of several where one stands."""
    several = isinstance(value, list) or (isinstance(value, str) and RANGE.fullmatch(value))
    return "; ranges and lists of values go under grid:" if several and key not in _LISTS else ""


def _settings(value: object) -> list[list[str]]:
    """Hyperparameters as the command line has them: `{hidden: [16, 16]}` is `hidden=[16, 16]`."""
    if not isinstance(value, Mapping):
        raise Misfit(_SETTINGS, f"expected keys and values in set, as {{updates: 2}}, got {value!r:.60}")
    texts = {name: part if isinstance(part, str) else json.dumps(part) for name, part in value.items()}
    return [[f"{name}={text}" for name, text in texts.items()]]


def _key_at(keys: Mapping[str, Path], place: Path) -> str:
    """The key whose value is at a place of the order, or else around it or inside it."""
    for key, path in keys.items():
        shared = min(len(path), len(place))
        if path[:shared] == place[:shared]:
            return key
    return place[-1] if place else ""
