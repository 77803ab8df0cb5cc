"""Reading of npz archives without unpickling; a damaged archive, or one that is too large, is refused."""

import math
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.lib import format as numpy_format
from numpy.lib.npyio import NpzFile

from madoc.data.sizes import LARGEST_DATASET, check_size
from madoc.data.validation import require_file
from madoc.errors import MadocError

ZIP_SIGNATURE = b"PK\x03\x04"
MAKE_AGAIN = "copy or make it again"
"""What to do about a log that cannot be read."""
_UNREADABLE = (OSError, ValueError, EOFError, RuntimeError, KeyError, zipfile.BadZipFile, zlib.error)


def holds(path: Path, *names: str) -> bool:
    """Whether the file is an npz archive with all of the named arrays; a damaged archive is refused."""
    if not _is_npz(path):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return {f"{name}.npy" for name in names} <= set(archive.namelist())
    except _UNREADABLE as error:
        raise _damaged(path, error) from error


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Every array of a data set by name; one that is missing, damaged, too large or holds Python objects is refused."""
    require_npz(path)
    return unpack(path, most=LARGEST_DATASET)


def require_npz(path: Path) -> None:
    """Refuse a file that is missing or no npz archive."""
    require_file(path)
    if not _is_npz(path):
        raise MadocError(f"{path} is not an npz file; pass the --format it has")


def unpack(path: Path, remedy: str = MAKE_AGAIN, *, most: int = LARGEST_DATASET) -> dict[str, np.ndarray]:
    """Every array of an archive by name.

    Raises:
        MadocError: The archive is damaged, holds anything but arrays, or more bytes than the bound; its sentence ends
            with the remedy.
    """
    headers = read_headers(path, remedy)
    check_size(sum(header.size for header in headers.values()), f"the arrays of {path}", most)
    return {name: read_array(path, name, remedy) for name in headers}


def read_array(path: Path, name: str, remedy: str = MAKE_AGAIN) -> np.ndarray:
    """One array of an archive."""
    try:
        with path.open("rb") as file, NpzFile(file, allow_pickle=False) as archive:
            return np.asarray(archive[name])
    except _UNREADABLE as error:
        raise _damaged(path, error, remedy) from error


@dataclass(frozen=True)
class Header:
    """What an archive tells of an array: its shape, the kind of its values, and its size in bytes."""

    shape: tuple[int, ...]
    dtype: np.dtype
    size: int


def read_headers(path: Path, remedy: str = MAKE_AGAIN) -> dict[str, Header]:
    """What an archive tells of its arrays, by name; none is read.

    Raises:
        MadocError: The archive is damaged, or holds anything but arrays or fewer values than an array says.
    """
    require_file(path)
    try:
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            return {_array_name(part.filename, path): _header(archive, part) for part in archive.infolist()}
    except _UNREADABLE as error:
        if isinstance(error, MadocError):
            raise
        raise _damaged(path, error, remedy) from error


def _array_name(member: str, path: Path) -> str:
    """Name of the array that a member of an archive holds."""
    if not member.endswith(".npy"):
        raise MadocError(f"expected only arrays in {path}, got the file {member!r}; give an archive of arrays alone")
    return member.removesuffix(".npy")


def _header(archive: zipfile.ZipFile, part: zipfile.ZipInfo) -> Header:
    """The header of one array; a ValueError says what is wrong with it."""
    with archive.open(part) as stream:
        version = numpy_format.read_magic(stream)
        read = {(1, 0): numpy_format.read_array_header_1_0}.get(version, numpy_format.read_array_header_2_0)
        shape, _, dtype = read(stream)
        begun = stream.tell()
    if dtype.hasobject:
        raise ValueError(f"{part.filename} holds Python objects")
    size = math.prod(shape) * dtype.itemsize
    if min((1, *shape)) < 0 or size > part.file_size - begun:
        raise ValueError(f"{part.filename} says that it has shape {shape}, and has {part.file_size:,} bytes")
    return Header(tuple(shape), dtype, size)


def _is_npz(path: Path) -> bool:
    """Whether the file begins like a zip archive, even if it was cut short."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(ZIP_SIGNATURE)) == ZIP_SIGNATURE


def _damaged(path: Path, error: Exception, remedy: str = MAKE_AGAIN) -> MadocError:
    return MadocError(
        f"cannot read {path} as npz ({error}); it is damaged, was cut short or holds Python objects, {remedy}"
    )
