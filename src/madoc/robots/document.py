"""YAML with the line of everything in it, so that a mistake is reported where it was made; and YAML written.

Pydantic's findings in such a document are each one sentence with that line.
"""

import io
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.constructor import RoundTripConstructor
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, Event, NodeEvent
from ruamel.yaml.nodes import MappingNode, Node

from madoc.errors import UNPRINTABLE, MadocError, nearest_hint

Whole = TypeVar("Whole", bound=BaseModel)
Place = tuple[str | int, ...]
"""Path to a value: keys and positions, as `("signals", 0, "name")`."""

LARGEST_FILE = 200_000
"""Largest size of a file in bytes; a larger one is refused. The spec of a robot with a hundred joints has 20,000."""
DEEPEST = 20
"""Deepest nesting of lists and mappings; anything deeper is refused."""
_YAML_ADVICE = {
    "mapping values are not allowed here": "; check the indentation, and put a value that holds a colon in quotes",
    "found character '\\t'": "; indent with spaces",
    "expected <block end>": "; check the indentation",
}
"""What to do about mistakes of YAML, by a part of the sentence in which its parser tells them."""
MOST_KEYS = 1000
"""Most keys of one mapping; with more the file is refused before they are looked at."""
MOST_PARTS = 20_000
"""Most values, keys, lists and mappings of a file; with more it is refused before it is read further."""

_WORDS = {
    "float_type": "a number",
    "float_parsing": "a number",
    "model_type": "keys and values",
    "dataclass_type": "keys and values",
    "dict_type": "keys and values",
    "list_type": "a list",
    "tuple_type": "a list",
    "int_type": "a whole number",
    "string_type": "text",
    "path_type": "text",
    "bool_type": "true or false",
    "string_pattern_mismatch": "a printable name",
}
"""What was expected, by pydantic's name of the mistake."""
LARGEST = 1e12
"""Largest size of a number, in any unit: no range or limit of a robot reaches further."""
_PRINTABLE = f"^[^{UNPRINTABLE}]+$"
Name = Annotated[str, Field(min_length=1, max_length=100, pattern=_PRINTABLE)]
File = Annotated[str, Field(min_length=1, max_length=4096, pattern=_PRINTABLE)]
Unit = Annotated[str, Field(max_length=40, pattern=f"^[^{UNPRINTABLE}]*$")]
Finite = Annotated[float, Field(allow_inf_nan=False, ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, le=LARGEST)]


@dataclass(frozen=True)
class Document:
    """The name of a YAML file and its content: mappings and lists that know their lines, and plain values."""

    file: str
    data: object

    def line(self, place: Place) -> int:
        """The line of a value, counted from 1; of the nearest part that would hold it where it is missing."""
        part = self.data
        line: int = part.lc.line if isinstance(part, CommentedMap | CommentedSeq) else 0
        for key in place:
            if not isinstance(part, CommentedMap | CommentedSeq) or key not in (part.lc.data or {}):
                break
            line, part = part.lc.data[key][0], part[key]
        return line + 1

    def error(self, place: Place, sentence: str) -> MadocError:
        """An error about the value at a place, with the file and the line in front."""
        return MadocError(f"{self.file}, line {self.line(place)}: {sentence}")

    @contextmanager
    def at(self, *place: str | int) -> Iterator[None]:
        """Put the file and the line of a value in front of an error that is raised inside."""
        try:
            yield
        except MadocError as error:
            raise type(error)(str(self.error(place, str(error)))) from error

    def unknown(self, place: Place, what: str, name: str, known: Iterable[str]) -> MadocError:
        """An error about a name that is not among the known ones; it lists the nearest of them."""
        return self.error(place, f"expected {what}, got {name!r}; {nearest_hint(name, known)}")


def read_document(
    content: bytes, file: str, *, what: str = "a robot's spec", remedy: str = "write one with: madoc init MODEL"
) -> Document:
    """Read YAML 1.2 that has no tags, no anchors and no key twice; anything else is refused with its line.

    Sentences say `what` the file should be, and that the `remedy` is for an empty one.
    """
    if len(content) > LARGEST_FILE:
        raise MadocError(f"{file} has {len(content):,} bytes, {what} at most {LARGEST_FILE:,}; is it the right file?")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise MadocError(f"{file}, line {line}: expected text in UTF-8, got byte {content[error.start]:#x}") from error
    reader = YAML()
    reader.Constructor = _Constructor
    try:
        _check_events(YAML(typ="safe", pure=True).parse(text))
        data = reader.load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = file if mark is None else f"{file}, line {mark.line + 1}"
        what = "" if isinstance(error, _Refusal) else "this is not YAML: "
        problem = str(error.problem or error.context)
        advice = next((advice for sign, advice in _YAML_ADVICE.items() if sign in problem), "")
        raise MadocError(f"{where}: {what}{problem}{advice}") from error
    except YAMLError as error:
        raise MadocError(f"{file}: this is not YAML: {' '.join(str(error).split())}") from error
    except (RecursionError, ValueError) as error:
        raise MadocError(f"{file}: this is not a YAML file that {what} could be") from error
    if data is None:
        raise MadocError(f"{file} is empty; {remedy}")
    return Document(file, data)


def yaml_text(content: object, *, width: int = 110, flow: bool | None = None) -> str:
    """Content as YAML, keys in their order; `flow` True writes all on one line, None only the innermost parts."""
    writer = YAML(typ="safe", pure=True)
    writer.default_flow_style, writer.width, writer.allow_unicode = flow, width, True
    writer.sort_base_mapping_type_on_output = False  # type: ignore[assignment]  # keys keep their order
    stream = io.StringIO()
    writer.dump(content, stream)
    return stream.getvalue()


class _Refusal(MarkedYAMLError):
    """YAML that is valid and yet not accepted in a spec."""


def _check_events(events: Iterable[Event]) -> None:
    """Refuse what no such file needs as soon as it comes: YAML takes long for files of many parts."""
    sizes: list[int] = []
    for count, event in enumerate(events):
        if isinstance(event, CollectionEndEvent):
            sizes.pop()
            continue
        if sizes:
            sizes[-1] += 1 if isinstance(event, NodeEvent) else 0
        problem = ""
        if sizes and sizes[-1] > 2 * MOST_KEYS:
            problem = (
                f"expected at most {MOST_KEYS:,} keys or {2 * MOST_KEYS:,} values in a row, got more; leave some out"
            )
        elif count > MOST_PARTS:
            problem = f"expected at most {MOST_PARTS:,} keys and values in a file, got more; leave some out"
        if problem:
            raise _Refusal(problem=problem, problem_mark=event.start_mark)
        if isinstance(event, CollectionStartEvent):
            sizes.append(0)
        _check_event(event, len(sizes))


def _check_event(event: Event, depth: int) -> None:
    """Refuse anchors, aliases, tags and deep nesting: a spec has no use for them, and they make YAML slow or unsafe."""
    if isinstance(event, AliasEvent) or getattr(event, "anchor", None):
        problem = "anchors and aliases (& and *) are not read here; write the value out"
    elif tag := getattr(event, "tag", None):
        problem = f"expected a plain value, got the tag {tag}; leave it out"
    elif depth > DEEPEST:
        problem = f"nested more than {DEEPEST} deep, which no such file is"
    else:
        return
    raise _Refusal(problem=problem, problem_mark=event.start_mark)


class _Constructor(RoundTripConstructor):
    """Takes only text as a key, and each key once."""

    def check_mapping_key(
        self, node: MappingNode, key_node: Node, mapping: CommentedMap, key: object, value: object
    ) -> bool:
        if not isinstance(key, str):
            number = isinstance(key, int | float) and not isinstance(key, bool)
            advice = "write 0.5 for a decimal 0,5, or put a name in quotes" if number else "put it in quotes"
            got = "a list or a mapping" if isinstance(key_node.value, list) else f"{key_node.value}; {advice}"
            problem = f"expected a word before the colon, got {got}"
        elif key in mapping:
            problem = f"{key!r} is given twice, first on line {mapping.lc.data[key][0] + 1}; keep one"
        else:
            return True
        raise _Refusal(problem=problem, problem_mark=key_node.start_mark)


# A date in a file, as the name of a folder of logs may be one, is text like any other word.
_Constructor.add_constructor("tag:yaml.org,2002:timestamp", RoundTripConstructor.construct_yaml_str)


class Part(BaseModel):
    """A part of a file: no unknown key is accepted, and no value is converted into another type."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def refuse(wrong: bool, sentence: str) -> None:
    """Raise a ValueError, which pydantic reports, where something is wrong."""
    if wrong:
        raise ValueError(sentence)


def validated(document: Document, whole: type[Whole], otherwise: str) -> Whole:
    """A file as its model; the first mistake is refused with its line, and `otherwise` what has no keys at all."""
    if not isinstance(document.data, dict):
        raise document.error((), otherwise)
    try:
        return whole.model_validate(document.data)
    except ValidationError as error:
        # What is missing may be there under a misspelt name, which says more.
        details = sorted(
            error.errors(), key=lambda detail: (detail["type"] == "missing", document.line(_place(detail)))
        )
        more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
        place = _place(details[0])
        part: type[BaseModel] = whole
        for key in place[:-1]:
            field = part.model_fields.get(str(key))
            kinds = () if field is None else (field.annotation, *get_args(field.annotation))
            part = next((kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)), part)
        raise document.error(place, mistake(details[0], place, list(part.model_fields)) + more) from error


def mistake(detail: ErrorDetails, place: Place, known: list[str]) -> str:
    """A finding of pydantic at a place of a file in words: what was expected, and what was there instead.

    `known` are the keys that the part around it may have.
    """
    kind, got = detail["type"], detail["input"]
    what = ".".join(str(part) for part in place if not isinstance(part, int))
    if kind in ("missing", "missing_argument"):
        *around, key = place
        return f"expected {key}: {'here' if not around else 'in this part of ' + str(around[0])}"
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"unknown key {place[-1]!r}; {nearest_hint(str(place[-1]), known)}"
    if kind == "value_error":
        return str(detail["ctx"]["error"])
    if kind in ("string_type", "path_type") and isinstance(got, int | float):
        return f"expected text in {what}, got {got!r}; put it in quotes"
    expected = detail["msg"].partition(" should ")[2].partition(" after ")[0].removeprefix("be ").removeprefix("have ")
    expected = _WORDS.get(kind, expected)
    if kind == "string_pattern_mismatch" and place == ("name",):
        expected = "a name of letters, digits, _ . and -"
    return f"expected {expected} in {what}, got {shown(got)}"


def _place(detail: ErrorDetails) -> Place:
    """The place of an error in the document, without pydantic's mark for a key of a dictionary."""
    return tuple(part for part in detail["loc"] if part != "[key]")


def shown(value: object) -> str:
    """A value of a file in a sentence."""
    if isinstance(value, dict):
        return "keys and values"
    if value is None or value == []:
        return "nothing" if value is None else "an empty list"
    text = str(value) if isinstance(value, float) and not math.isfinite(value) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
