"""The files of a model: read once and completely, and only from the model's own folder unless others are allowed."""

import base64
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from madoc.errors import MadocError, NotAllowed
from madoc.robots.model_xml import LARGEST_AREA, MOST_ELEMENTS, ModelXml, Reference, read_xml
from madoc.runs.files import read_bytes

LARGEST = 100_000_000
"""Largest size of all files of a model together, bytes; more is refused."""
LARGEST_XML = 10_000_000
"""Largest size of one XML file of a model, bytes; a larger one is refused."""
_PNG = b"\x89PNG\r\n\x1a\n"


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
