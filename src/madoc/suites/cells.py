"""Cells of a suite: orders made from the keys of its file, in folders named by what they ask, and plans that list them.

Keys have the names that the command line has, underscores for hyphens.
"""

import dataclasses
import functools
import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from pydantic import TypeAdapter, ValidationError
from tyro.conf import Suppress

from madoc.errors import MadocError, nearest_hint, unknown_name
from madoc.pipeline.orders import CalibrationOrder, EvaluationOrder, PolicyOrder, RecordOrder
from madoc.robots.document import mistake, shown
from madoc.runs.files import read_bytes, replacing
from madoc.suites.grid import RANGE

Order = RecordOrder | CalibrationOrder | PolicyOrder | EvaluationOrder
Asked = TypeVar("Asked", RecordOrder, CalibrationOrder, PolicyOrder, EvaluationOrder)
Place = tuple[str, ...]
"""Names of the parts of an order that lead to a value."""

Kind = Literal["record", "calibrate", "learn", "evaluate"]

KINDS: Mapping[Kind, type] = {
    "record": RecordOrder,
    "calibrate": CalibrationOrder,
    "learn": PolicyOrder,
    "evaluate": EvaluationOrder,
}
"""The order of each kind of cell."""

RECORDED = "data.npz"
"""Name of the file that a recording leaves in its cell."""
_SUPPRESSED = get_args(Suppress[int])[1:]
_SETTINGS = "set"
"""Key of hyperparameters, which are `name=value` on the command line and keys and values in a file."""
_LISTS = {"data": "a path or a list of paths", "parameters": "a name or a list of names"}
"""Keys whose value is a list, or a single text for a list of one, and that in words."""


@functools.cache
def keys_of(order: Any) -> Mapping[str, Place]:
    """Every key of an order, and where its value is in it; the keys of its parts stand beside its own."""
    hints = get_type_hints(order, include_extras=True)
    nested: dict[str, Any] = {}
    keys: dict[str, Place] = {}
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


def build(order: type[Asked], given: Mapping[str, object]) -> Asked:
    """An order from the keys of a suite file; no value is converted into another type.

    Raises:
        MadocError: A key is unknown or missing, or a value is refused; it names the key.
    """
    kind: Any = order  # mypy does not see that a dataclass itself can be hashed
    keys = keys_of(kind)
    nested: dict[str, Any] = {}
    for key, value in given.items():
        if key not in keys:
            raise MadocError(f"unknown key {key!r}; {nearest_hint(key, keys)}", option=key)
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
        sentence = mistake(detail, (key,), list(keys)) + _grid_hint(key, given.get(key))
        raise MadocError(sentence, option=key) from error


@functools.cache
def adapter(order: Any) -> TypeAdapter:  # type: ignore[type-arg]  # beartype knows no TypeAdapter[...]
    """What reads and writes an order as JSON."""
    return TypeAdapter(order)


def stored(order: Order) -> dict[str, Any]:
    """An order as JSON, without what it leaves at its default."""
    kind: Any = type(order)
    return adapter(kind).dump_python(order, mode="json", exclude_defaults=True)


def _bare(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type without its annotations, and these."""
    return (get_args(hint)[0], get_args(hint)[1:]) if get_origin(hint) is Annotated else (hint, ())


def _listed(key: str, value: object) -> object:
    """A single text of a key that takes several as a list of one."""
    if key not in _LISTS or isinstance(value, list):
        return value
    if not isinstance(value, str):
        raise MadocError(f"expected {_LISTS[key]} in {key}, got {shown(value)}", option=key)
    return [value]


def _grid_hint(key: str, value: object) -> str:
    """Where several values of one key are written, after the refusal of several where one stands."""
    several = isinstance(value, list) or (isinstance(value, str) and RANGE.fullmatch(value))
    return "; ranges and lists of values go under grid:" if several and key not in _LISTS else ""


def _settings(value: object) -> list[list[str]]:
    """Hyperparameters as the command line has them: `{hidden: [16, 16]}` is `hidden=[16, 16]`."""
    if not isinstance(value, Mapping):
        sentence = f"expected keys and values in set, as {{updates: 2}}, got {value!r:.60}"
        raise MadocError(sentence, option=_SETTINGS)
    texts = {name: part if isinstance(part, str) else json.dumps(part) for name, part in value.items()}
    return [[f"{name}={text}" for name, text in texts.items()]]


def _key_at(keys: Mapping[str, Place], place: Place) -> str:
    """The key whose value is at a place of the order, or else around it or inside it."""
    for key, path in keys.items():
        shared = min(len(path), len(place))
        if path[:shared] == place[:shared]:
            return key
    return place[-1] if place else ""


@dataclasses.dataclass(frozen=True, slots=True)
class Cell:
    """A stage of a suite.

    Attributes:
        name: Hash of what it asks; its folder has this name.
        kind: What is done.
        order: The order, as `stored` writes it; paths are absolute.
        needs: Name of the cell whose result it takes; None where it takes none.
        entry: Position in the suite file of the entry it comes from, from 0.
        robot: Name of the robot whose log it takes, where an entry names several.
        wanted: Whether the file asks for it itself, and not only for what needs it.
    """

    name: str
    kind: Kind
    order: Mapping[str, Any]
    needs: str | None = None
    entry: int = 0
    robot: str = ""
    wanted: bool = True

    def read(self) -> Order:
        """The order itself."""
        return adapter(KINDS[self.kind]).validate_python(dict(self.order))

    @property
    def asks(self) -> dict[str, Any]:
        """What it asks, by the keys of a suite file; values left at their default are not among them."""
        values: dict[str, Any] = {}
        for key, path in keys_of(KINDS[self.kind]).items():
            part: Any = self.order
            for name in path:
                part = part.get(name) if isinstance(part, Mapping) else None
            if part is not None:
                values[key] = part
        return values

    def folder(self, suite: Path) -> Path:
        """Its run folder inside the folder of a suite."""
        return suite / "cells" / self.name


def hashed(*parts: object) -> str:
    """The name of what is asked: 16 digits that change with anything in it."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def write_plan(suite: Path, name: str, cells: Iterable[Cell]) -> None:
    """Leave the plan `plans/NAME.jsonl` in a suite's folder, a cell a line.

    Raises:
        MadocError: The folder cannot be made or written.
    """
    file = suite / "plans" / f"{name}.jsonl"
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MadocError(f"could not make the folder {file.parent}: {error.strerror or error}") from error
    with replacing(file) as stream:
        for cell in cells:
            stream.write(json.dumps(dataclasses.asdict(cell), ensure_ascii=False).encode() + b"\n")


def read_plans(suite: Path, name: str | None = None) -> list[Cell]:
    """The cells of the plan of this name in a suite's folder, by default of all plans; each once, in their order.

    Raises:
        MadocError: There is no plan, or none of that name, or one is damaged.
    """
    files = sorted((suite / "plans").glob("*.jsonl"))
    if not files:
        raise MadocError(f"there is no plan of a suite in {suite}; make one with: madoc suite SUITE.yaml --out {suite}")
    if name is not None:
        names = [file.stem for file in files]
        if name not in names:
            raise unknown_name(f"plan of {suite}", name, names)
        files = [file for file in files if file.stem == name]
    cells: dict[str, Cell] = {}
    for file in files:
        for number, line in enumerate(read_bytes(file).decode().splitlines(), 1):
            try:
                cell = Cell(**json.loads(line))
            except (ValueError, TypeError) as error:
                raise MadocError(f"{file}, line {number} is damaged ({error}); run madoc suite again") from error
            cells.setdefault(cell.name, cell)
    return list(cells.values())
