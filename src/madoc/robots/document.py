"""A YAML file with the line of everything in it, so that a mistake is answered where it was made."""

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import yaml

from madoc.errors import MadocError

Place = tuple[str | int, ...]
"""Where something stands: keys and positions, as `("signals", 0, "name")`."""

LARGEST = 200_000
"""Bytes. A spec file of a robot with a hundred joints has some twenty thousand."""
DEEPEST = 20

_INTEGER = re.compile(r"[-+]?[0-9]+")
_NUMBER = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_WORDS = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".inf", "+.inf"), math.inf),
    "-.inf": -math.inf,
    ".nan": math.nan,
}


@dataclass(frozen=True)
class Document:
    """What a YAML file says, and on which line.

    Attributes:
        file: Its name, for sentences.
        data: Dictionaries, lists, text, numbers, booleans, None.
        lines: The line of every place, counted from 1.
    """

    file: str
    data: Any
    lines: dict[Place, int]

    def line(self, place: Place) -> int:
        """The line of a place, or of what should have held it."""
        while place not in self.lines:
            place = place[:-1]
        return self.lines[place]

    def error(self, place: Place, sentence: str) -> MadocError:
        """The refusal of what stands at a place."""
        return MadocError(f"{self.file}, line {self.line(place)}: {sentence}")

    def unknown(self, place: Place, what: str, name: str, known: Iterable[str]) -> MadocError:
        """The refusal of a name that is not among the known ones, with the nearest."""
        names = list(known)
        near = nearest(name, names)
        if near:
            hint = f"nearest: {', '.join(near)}"
        else:
            hint = f"there are: {', '.join(names[:12])}" if names else "there is none"
        return self.error(place, f"expected {what}, got {name!r}; {hint}")


def nearest(wanted: str, names: list[str]) -> list[str]:
    """At most three names like the wanted one: those that hold it first, then those spelled like it."""
    by_case = {name.lower(): name for name in names}
    close = [by_case[name] for name in get_close_matches(wanted.lower(), list(by_case), n=3, cutoff=0.5)]
    holding = [name for name in names if wanted and wanted.lower() in name.lower()]
    return list(dict.fromkeys([*holding, *close]))[:3]


def read_document(content: bytes, file: str) -> Document:
    """Read YAML without tags, anchors or repeated keys.

    Words are as in YAML 1.2: `1e-3` is a number, `on` is text.

    Raises:
        MadocError: It is no such YAML; the sentence names the line.
    """
    if len(content) > LARGEST:
        raise MadocError(
            f"{file} has {len(content):,} bytes, a robot's spec at most {LARGEST:,}; is it the right file?"
        )
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise MadocError(f"{file}, line {line}: expected text in UTF-8, got byte {content[error.start]:#x}") from error
    try:
        depth = 0
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            _refuse_cleverness(event, depth, file)
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except MadocError:
        raise
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = file if mark is None else f"{file}, line {mark.line + 1}"
        raise MadocError(f"{where}: this is not YAML: {error.problem or error.context}") from error
    except yaml.YAMLError as error:
        raise MadocError(f"{file}: this is not YAML: {' '.join(str(error).split())}") from error
    except (RecursionError, ValueError) as error:
        raise MadocError(f"{file}: this is not a YAML file that a robot's spec could be") from error
    if root is None:
        raise MadocError(f"{file} is empty; write one with: madoc init MODEL")
    lines: dict[Place, int] = {}
    return Document(file, _value(root, (), _Reader(file, lines)), lines)


def _refuse_cleverness(event: yaml.Event, depth: int, file: str) -> None:
    """Refuse anchors, aliases, tags and deep nesting: a spec has no use for them, and they make YAML slow or unsafe."""
    where = f"{file}, line {event.start_mark.line + 1}"
    if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
        raise MadocError(f"{where}: anchors and aliases (& and *) are not read here; write the value out")
    if getattr(event, "tag", None):
        raise MadocError(f"{where}: expected a plain value, got the tag {event.tag}; leave it out")
    if depth > DEEPEST:
        raise MadocError(f"{where}: nested more than {DEEPEST} deep, which no spec is")


@dataclass(frozen=True)
class _Reader:
    file: str
    lines: dict[Place, int]

    def error(self, node: yaml.Node, sentence: str) -> MadocError:
        return MadocError(f"{self.file}, line {node.start_mark.line + 1}: {sentence}")


def _value(node: yaml.Node, place: Place, reader: _Reader) -> Any:
    reader.lines[place] = node.start_mark.line + 1
    if isinstance(node, yaml.SequenceNode):
        return [_value(child, (*place, index), reader) for index, child in enumerate(node.value)]
    if isinstance(node, yaml.MappingNode):
        return dict(_items(node, place, reader))
    if isinstance(node, yaml.ScalarNode) and node.style is None:
        return _plain(node.value)
    return node.value


def _items(node: yaml.MappingNode, place: Place, reader: _Reader) -> Iterator[tuple[str, Any]]:
    seen: dict[str, int] = {}
    for key_node, value_node in node.value:
        if not isinstance(key_node, yaml.ScalarNode):
            raise reader.error(key_node, "expected a word before the colon, got a list or a mapping")
        key, line = key_node.value, key_node.start_mark.line + 1
        if key in seen:
            raise reader.error(key_node, f"{key!r} is given twice, first on line {seen[key]}; keep one")
        seen[key] = line
        value = _value(value_node, (*place, key), reader)
        reader.lines[(*place, key)] = line
        yield key, value


def _plain(text: str) -> Any:
    """A scalar without quotes, as YAML 1.2's core schema reads it."""
    if text in _WORDS:
        return _WORDS[text]
    if _INTEGER.fullmatch(text) and len(text) < 20:
        return int(text)
    return float(text) if _NUMBER.fullmatch(text) else text
