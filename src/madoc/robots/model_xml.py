"""The XML of a model: read by the standard parser with entities off, what it refers to, and how large it asks to be."""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NoReturn
from xml.parsers import expat

from madoc.errors import MadocError

MOST_ELEMENTS = 50_000
"""Largest number of elements of a model, those that are replicated counted as often as they are."""
DEEPEST = 400
"""Deepest nesting of elements; MuJoCo's own parser ends at 500."""
_FILES = ("file", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
"""Attributes in which an element of an MJCF names a file."""
_SIZED = {
    ("size", "nkey"): 10_000,
    ("size", "nuserdata"): 1_000_000,
    ("size", "njmax"): 1_000_000,
    ("size", "nconmax"): 1_000_000,
    ("size", "nstack"): 100_000_000,
    ("numeric", "size"): 1_000_000,
    ("user", "dim"): 10_000,
    ("contact", "num"): 10_000,
    ("replicate", "count"): MOST_ELEMENTS,
    ("composite", "count"): MOST_ELEMENTS,
    ("flexcomp", "count"): MOST_ELEMENTS,
    ("flexcomp", "cellcount"): MOST_ELEMENTS,
    ("flex", "cellcount"): MOST_ELEMENTS,
    ("mesh", "maxhullvert"): 1_000_000,
    ("camera", "resolution"): 2**24,
}
"""Largest value of an attribute of an element, or the largest product of its values where it has several."""
_ANYWHERE = {
    "nsample": 100_000,
    "actdim": 10_000,
    "octree_maxdepth": 10,
    "iterations": 100_000,
    "ls_iterations": 100_000,
    "noslip_iterations": 100_000,
    "ccd_iterations": 100_000,
    "sdf_iterations": 100_000,
    "sdf_initpoints": 10_000,
    **{f"nuser_{kind}": 1000 for kind in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")},
}
"""Largest value of an attribute of any element."""
_AREAS = (("hfield", "nrow", "ncol"), ("texture", "width", "height"))
"""Elements with an area, and the attributes that it is the product of."""
LARGEST_AREA = 4096**2
"""Largest area of a height field, texture or picture, in points."""
LARGEST_MEMORY = 2**30
"""Most memory that a model may ask for, bytes."""
_UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40, "p": 2**50, "e": 2**60}


@dataclass(frozen=True)
class Element:
    """An element with its attributes, its line, and how often it is there, as elements around it replicate it."""

    tag: str
    attributes: Mapping[str, str]
    line: int
    times: float


@dataclass(frozen=True)
class Reference:
    """A file that an element names: `model` is XML that is read as well, `texture` lies in the folder of textures."""

    name: str
    kind: str
    times: float


@dataclass(frozen=True)
class ModelXml:
    """What a file of a model holds: the tag of its first element, and all elements in their order."""

    file: str
    root: str
    elements: tuple[Element, ...]

    @property
    def is_urdf(self) -> bool:
        """Whether it is URDF: its first element is `robot`."""
        return self.root == "robot"

    def folders(self, kind: str) -> list[str]:
        """The folders in which its compiler looks for files of a kind, the one that counts first."""
        own = "texturedir" if kind == "texture" else "meshdir"
        compilers = [element.attributes for element in self.elements if element.tag == "compiler"]
        return [compiler[name] for name in (own, "assetdir") for compiler in reversed(compilers) if name in compiler]

    def references(self) -> Iterator[Reference]:
        """The files that MuJoCo reads for its elements."""
        attached: dict[str, float] = {}
        for element in self.elements:
            if element.tag == "attach":
                name = element.attributes.get("model", "")
                attached[name] = attached.get(name, 0.0) + element.times
        for element in self.elements:
            kind = {"include": "model", "model": "model", "texture": "texture"}.get(element.tag, "mesh")
            attached_as = element.attributes.get("name", "")
            times = attached.get(attached_as, 1.0) if element.tag == "model" else element.times
            for attribute in ("filename",) if self.is_urdf else _FILES:
                if element.attributes.get(attribute) and not (self.is_urdf and element.tag != "mesh"):
                    yield Reference(element.attributes[attribute], kind, times)

    @property
    def size(self) -> float:
        """Number of elements, those that are replicated counted as often as they are."""
        return sum(element.times for element in self.elements)


def read_xml(content: bytes, file: str) -> ModelXml:
    """The elements of a file of a model.

    Raises:
        MadocError: It is no XML in UTF-8, has macros or a document type, or asks for more than any model needs.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise MadocError(f"model {file} is not text; expected MJCF or URDF") from error
    reading = _Reading(file)
    try:
        reading.parser.Parse(text.encode(), True)
    except expat.ExpatError as error:
        raise MadocError(
            f"model {file} cannot be read: it is not XML, {expat.ErrorString(error.code)} in line {error.lineno}"
        ) from error
    if any(element.tag.startswith("xacro:") for element in reading.elements):
        raise MadocError(f"model {file} has xacro macros; expand them first: xacro {file} > robot.urdf")
    return ModelXml(file, reading.elements[0].tag, tuple(reading.elements))


class _Reading:
    """The elements that the parser has met in a file."""

    def __init__(self, file: str) -> None:
        self.file, self.elements, self._around = file, [], [1.0]
        self.parser = expat.ParserCreate("UTF-8")  # MuJoCo heeds no other encoding that a file may declare
        self.parser.StartDoctypeDeclHandler = self._refuse_type
        self.parser.StartElementHandler = self._begin
        self.parser.EndElementHandler = self._end

    elements: list[Element]

    def _refuse_type(self, *_: object) -> NoReturn:
        raise MadocError(f"model {self.file} declares a document type (<!DOCTYPE>), which no model needs; leave it out")

    def _begin(self, tag: str, attributes: dict[str, str]) -> None:
        element = Element(tag, attributes, self.parser.CurrentLineNumber, self._around[-1])
        self.elements.append(element)
        if len(self.elements) > MOST_ELEMENTS or len(self._around) > DEEPEST:
            what = f"more than {MOST_ELEMENTS:,} elements" if len(self._around) <= DEEPEST else "elements too deep"
            raise MadocError(f"model {self.file} has {what}, which no model needs; is it the right file?")
        _check_sizes(element, self.file)
        counted = tag in ("replicate", "composite", "flexcomp")
        times = math.prod(_numbers(attributes.get("count", ""))) if counted else 1.0
        self._around.append(self._around[-1] * max(times, 1.0))
        if counted:
            self.elements.append(Element("copies", {}, element.line, self._around[-1]))

    def _end(self, tag: str) -> None:
        self._around.pop()


def _check_sizes(element: Element, file: str) -> None:
    """Refuse an element that asks for more than any model needs, before MuJoCo makes it."""
    for name, text in element.attributes.items():
        most = _SIZED.get((element.tag, name), _ANYWHERE.get(name))
        asked = math.prod(map(abs, _numbers(text))) if most is not None else 0.0
        if most is not None and asked > most:
            raise _too_much(element, file, f"{name} of at most {most:,}", text)
    for tag, *sides in _AREAS:
        if element.tag == tag:
            area = math.prod(abs(number) for side in sides for number in _numbers(element.attributes.get(side, "")))
            if area > LARGEST_AREA:
                raise _too_much(element, file, f"{' times '.join(sides)} of at most {LARGEST_AREA:,}", f"{area:,.0f}")
    memory = re.fullmatch(r"\s*(\d+)([kmgtpe]?)\s*", element.attributes.get("memory", "").lower())
    if element.tag == "size" and memory and int(memory[1]) * _UNITS[memory[2]] > LARGEST_MEMORY:
        raise _too_much(element, file, "memory of at most 1G", element.attributes["memory"])


def _too_much(element: Element, file: str, expected: str, got: str) -> MadocError:
    return MadocError(
        f"model {file}, line {element.line}: expected {expected} in <{element.tag}>, got {got[:40]}; make it smaller"
    )


def _numbers(text: str) -> list[float]:
    """The numbers of an attribute; what is none is left to MuJoCo to refuse."""
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        return []
