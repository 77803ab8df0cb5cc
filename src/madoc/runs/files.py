"""Files written whole or not at all, and strict JSON."""

import json
import math
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from madoc.errors import MadocError

LARGEST = 150_000_000
"""Largest size of a file that is read whole, bytes, where nothing else is said; a larger one is refused."""


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A binary stream that replaces the file `path` at the end of the block; an error leaves the old file.

    After the block the content is on the disk, not in a cache: a power cut leaves the old or the new file.

    Raises:
        MadocError: The file cannot be written (no permission, disk full).
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.unlink(missing_ok=True)
        with temporary.open("xb") as stream:  # never through a link that another user has put there
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except OSError as error:
        raise MadocError(
            f"could not write {path}: {error.strerror or error}; what it held before is untouched"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Delete the half-written files of killed processes from a folder that no other process writes to."""
    for leftover in folder.glob(".*.tmp"):
        leftover.unlink(missing_ok=True)


def write_json(path: Path, value: object) -> None:
    """Write `value` as indented strict JSON, whole or not at all.

    Raises:
        MadocError: JSON cannot express `value` (NaN, an object), or writing failed.
    """
    content = json_text(value, what=path.name, indent=2) + "\n"
    with replacing(path) as stream:
        stream.write(content.encode())


def json_text(value: object, *, what: str, indent: int | None = None, ascii_only: bool = False) -> str:
    """Strict JSON on one line, or indented; with `ascii_only` other letters are written as numbers.

    Raises:
        MadocError: JSON cannot express `value`; the sentence names the place inside `what`.
    """
    try:
        return json.dumps(value, allow_nan=False, indent=indent, ensure_ascii=ascii_only)
    except (TypeError, ValueError) as error:
        place = _unwritable(value, what) or f"{what}: {error}"
        raise MadocError(f"cannot write as JSON: {place}") from error


def read_bytes(path: Path, *, most: int = LARGEST) -> bytes:
    """The content of a regular file of at most so many bytes; a pipe or device is not waited for.

    Raises:
        MadocError: The file is missing, unreadable, larger, or no regular file.
    """
    try:
        with open(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)), "rb") as file:
            state = os.fstat(file.fileno())
            if not stat.S_ISREG(state.st_mode):
                raise MadocError(f"could not read {path}: it is no regular file; check the path")
            if state.st_size > most:
                raise MadocError(
                    f"{path} has {state.st_size:,} bytes, more than the {most:,} that such a file may have"
                )
            return file.read(most)
    except OSError as error:
        raise MadocError(f"could not read {path}: {error.strerror or error}") from error


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        MadocError: The file is missing, unreadable or not JSON.
    """
    try:
        return json.loads(read_bytes(path).decode())
    except (ValueError, RecursionError) as error:
        if isinstance(error, MadocError):
            raise
        raise MadocError(f"{path} is not valid JSON ({error}); restore it or delete it") from error


def _unwritable(value: object, place: str) -> str | None:
    """The first part of a nested value that JSON cannot express, with its place; None if there is none."""
    if value is None or isinstance(value, bool | int | str):
        return None
    if isinstance(value, float):
        return None if math.isfinite(value) else f"{place} is {value}, expected a finite number"
    if isinstance(value, Mapping):
        keys = [key for key in value if not isinstance(key, str)]
        if keys:
            return f"{place} has the key {keys[0]!r}, expected a string"
        inner = (_unwritable(child, f"{place}.{key}") for key, child in value.items())
    elif isinstance(value, list | tuple):
        inner = (_unwritable(child, f"{place}[{index}]") for index, child in enumerate(value))
    else:
        return f"{place} is a {type(value).__name__}, expected a number, string, list, dict or null"
    return next((place for place in inner if place), None)


def _sync_folder(folder: Path) -> None:
    """Force a renamed entry of a folder to the disk; Windows has no such call and needs none."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
