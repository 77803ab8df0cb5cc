"""The files of a model: read once and completely, and only from the model's own folder unless others are allowed.

Their XML is read by the standard parser with entities off: what it refers to, and how large it asks to be.
"""

import base64
import math
import os
import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import NoReturn
from xml.parsers import expat

from madoc.errors import MadocError, NotAllowed
from madoc.runs.files import read_bytes

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

LARGEST = 100_000_000
"""Largest size of all files of a model together, bytes; more is refused."""
LARGEST_XML = 10_000_000
"""Largest size of one XML file of a model, bytes; a larger one is refused."""
_PNG = b"\x89PNG\r\n\x1a\n"


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


@dataclass(frozen=True)
class ModelFiles:
    """The name of a model file, and the contents of it and of all files that it refers to.

    A file is named by its path from the model file's folder, or as the model names it.
    """

    main: str
    files: tuple[tuple[str, bytes], ...]

    @classmethod
    def read(cls, path: Path, *, allow_outside: bool = False) -> "ModelFiles":
        """Read a model file and everything that it refers to.

        Raises:
            MadocError: A file is missing or no regular file, or the model is no XML or too large.
            NotAllowed: A file lies outside the model's folder, and that is not allowed.
        """
        disk = _Disk(path, allow_outside)
        contents = {path.name: disk.content(path, "")}
        xmls = {path.name: _xml(contents[path.name], path.name)}
        waiting = [path.name]
        while waiting:
            name = waiting.pop(0)
            for reference in xmls[name].references():
                folders = [*xmls[name].folders(reference.kind), *xmls[path.name].folders(reference.kind)]
                key, file = disk.found(reference, name, folders, urdf=xmls[name].is_urdf)
                if key in contents:
                    continue
                contents[key] = disk.content(file, reference.name, path.name)
                if sum(map(len, contents.values())) > LARGEST:
                    raise MadocError(f"the files of {path.name} have more than {LARGEST:,} bytes; make meshes coarser")
                if reference.kind == "model":
                    xmls[key] = _xml(contents[key], key)
                    waiting.append(key)
        return cls(path.name, tuple(contents.items()))

    def to_json(self) -> dict[str, object]:
        """The files for JSON: text as it is, anything else compressed."""
        return {"main": self.main, "contents": {name: _stored(content) for name, content in self.files}}

    @classmethod
    def from_json(cls, stored: Mapping[str, object]) -> "ModelFiles":
        """The files that `to_json` wrote; a ValueError says what is damaged."""
        main, contents = stored.get("main"), stored.get("contents")
        if not isinstance(main, str) or not isinstance(contents, Mapping) or main not in contents:
            raise ValueError("its model has no main file or no contents")
        restored: dict[str, bytes] = {}
        for name, content in contents.items():
            restored[name] = _restored(content, LARGEST - sum(map(len, restored.values())))
        return cls(main, tuple(restored.items()))

    def parts(self) -> tuple[str, dict[str, bytes], dict[str, bytes]]:
        """The text of the main file, the XML files that it refers to, and all others, by name.

        Raises:
            MadocError: A file is no XML, asks for too much, or refers to one that is not here: MuJoCo would look for it
                on the disk.
        """
        contents = dict(self.files)
        here = {PurePosixPath(name).name: name for name in contents}
        xmls: dict[str, ModelXml] = {}
        _count(self.main, contents, here, xmls)
        for name, content in contents.items():
            if name not in xmls:
                _check_picture(name, content)
        includes = {name: contents[name] for name in xmls if name != self.main}
        assets = {name: content for name, content in contents.items() if name not in xmls}
        return contents[self.main].decode("utf-8-sig"), includes, assets


def _count(name: str, contents: Mapping[str, bytes], here: Mapping[str, str], xmls: dict[str, ModelXml]) -> float:
    """The number of elements of an XML file and those in it; each file is read once, into `xmls`."""
    xmls[name] = xml = _xml(contents[name], name)
    size = xml.size
    for reference in xml.references():
        held = here.get(PurePosixPath(reference.name).name)
        if held is None:
            raise MadocError(
                f"model {name} refers to {reference.name}, which is not among the files that are kept with it; "
                "restore the run folder, or load the spec again"
            )
        if reference.kind == "model" and held not in xmls:
            size += reference.times * _count(held, contents, here, xmls)
        if size > MOST_ELEMENTS:
            break
    if size > MOST_ELEMENTS:
        raise MadocError(f"model {name} has {size:,.0f} elements, a model may have {MOST_ELEMENTS:,}; replicate fewer")
    return size


@dataclass(frozen=True)
class _Disk:
    """The folder of a model file; nothing outside of it is read unless that is allowed."""

    model: Path
    allow_outside: bool

    def found(self, reference: Reference, owner: str, folders: list[str], *, urdf: bool) -> tuple[str, Path]:
        """The name under which a file is kept that an XML file, the owner, refers to, and its path; it is there."""
        folder = self.model.parent
        for candidate in self._candidates(reference, folder / PurePosixPath(owner).parent, [*folders, ""], urdf):
            if candidate.exists():
                absolute, root = (os.path.abspath(path) for path in (candidate, folder))
                inside = Path(absolute).is_relative_to(root)
                key = os.path.relpath(absolute, root) if inside else str(candidate)
                return reference.name if urdf else Path(key).as_posix(), candidate
        where = "neither beside it nor in its package" if urdf else "missing"
        raise MadocError(f"{self.model.name} refers to {reference.name}, which is {where}; check the path")

    def _candidates(self, reference: Reference, owner: Path, folders: list[str], urdf: bool) -> Iterator[Path]:
        """Where a file may be, the likeliest first."""
        bare, folder = reference.name.removeprefix("file://").removeprefix("package://"), self.model.parent
        if urdf:
            yield from (folder / within / bare for within in folders)
            inside = PurePosixPath(bare).parts[1:] if reference.name.startswith("package://") else (bare,)
            yield from (above.joinpath(*inside) for above in self.model.parents[:3])
        elif reference.kind == "model":
            yield from (folder / bare, owner / bare)
        else:
            yield from (root / within / bare for root in dict.fromkeys((folder, owner)) for within in folders)
        yield folder / PurePosixPath(bare).name

    def content(self, path: Path, named: str, owner: str = "") -> bytes:
        """The content of a file, which is `named` in the model; one outside the folder is refused."""
        refers = f"{owner} refers to {named}, which is" if owner else f"there is no model file {path}: it is"
        if not path.is_file():
            kind = "a directory" if path.is_dir() else "no regular file" if path.exists() else "missing"
            raise MadocError(f"{refers} {kind}; check the path")
        if not self.allow_outside and not path.resolve().is_relative_to(self.model.parent.resolve()):
            who = f"{owner} refers to {named}" if owner else f"the model file {path.name} is a link"
            raise NotAllowed(
                f"{who}, outside the folder of the model, and a run folder would keep it; if you want that pass "
                "--allow-outside (in Python allow_outside=True)"
            )
        return read_bytes(path, most=LARGEST)


def _xml(content: bytes, name: str) -> ModelXml:
    if len(content) > LARGEST_XML:
        raise MadocError(f"model {name} has {len(content):,} bytes, a file of XML at most {LARGEST_XML:,}; shorten it")
    return read_xml(content, name)


def _check_picture(name: str, content: bytes) -> None:
    """Refuse a picture of more points than its bytes suggest, before it is unpacked."""
    if content.startswith(_PNG) and len(content) >= 24:
        width, height = struct.unpack(">II", content[16:24])
        if width * height > LARGEST_AREA:
            raise MadocError(f"{name} has {width:,} times {height:,} points, at most {LARGEST_AREA:,}; make it smaller")


def _stored(content: bytes) -> str | dict[str, str]:
    try:
        return content.decode()
    except UnicodeDecodeError:
        return {"zlib_base64": base64.b64encode(zlib.compress(content)).decode()}


def _restored(stored: object, most: int) -> bytes:
    """The content of a file that `_stored` wrote, of at most so many bytes."""
    if isinstance(stored, str):
        content, more = stored.encode(), b""
    elif isinstance(stored, Mapping):
        reader = zlib.decompressobj()
        try:
            content = reader.decompress(base64.b64decode(stored["zlib_base64"]), max(most, 1))
            more = reader.unconsumed_tail
        except (zlib.error, TypeError, KeyError) as error:
            raise ValueError(f"a file of its model is damaged ({error})") from error
        if not more and not reader.eof:
            raise ValueError("a file of its model is cut short")
    else:
        raise ValueError(f"a file of its model is a {type(stored).__name__}")
    if more or len(content) > most:
        raise ValueError(f"the files of its model have more than {LARGEST:,} bytes")
    return content
