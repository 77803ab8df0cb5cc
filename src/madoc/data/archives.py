"""Files of arrays, npz and HDF5, read without unpickling; a damaged one, or one that is too large, is refused.

The values of an HDF5 file have to lie in the file itself: one that names others is refused before it is read.
"""

import math
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import h5py
import numpy as np
from numpy.lib import format as numpy_format
from numpy.lib.npyio import NpzFile

from madoc.data.validation import LARGEST, LARGEST_DATASET, check_size, require_file
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


@dataclass(frozen=True)
class Stored:
    """An array of a file that has not been read; `size` is that in memory, bytes, of values of any length the least."""

    shape: tuple[int, ...]
    dtype: np.dtype
    size: int
    read: Callable[[], np.ndarray]


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Every array of a data set by name; one that is missing, damaged, too large or holds Python objects is refused."""
    require_npz(path)
    return unpack(path)


def require_npz(path: Path) -> None:
    """Refuse a file that is missing or no npz archive."""
    require_file(path)
    if not _is_npz(path):
        raise MadocError(f"{path} is not an npz file; pass the --format it has")


def unpack(path: Path, remedy: str = MAKE_AGAIN) -> dict[str, np.ndarray]:
    """Every array of an archive by name.

    Raises:
        MadocError: The archive is damaged, holds anything but arrays, or more than `LARGEST_DATASET`; its sentence ends
            with the remedy.
    """
    arrays = stored_in_npz(path, remedy)
    check_size(sum(array.size for array in arrays.values()), f"the arrays of {path}", LARGEST_DATASET)
    return {name: array.read() for name, array in arrays.items()}


def stored_in_npz(path: Path, remedy: str = MAKE_AGAIN) -> dict[str, Stored]:
    """The arrays of an archive by name; none is read.

    Raises:
        MadocError: The archive is damaged, or holds anything but arrays or fewer values than an array says.
    """
    require_file(path)

    def read(name: str) -> np.ndarray:
        try:
            with path.open("rb") as file, NpzFile(file, allow_pickle=False) as archive:
                return np.asarray(archive[name])
        except _UNREADABLE as error:
            raise _damaged(path, error, remedy) from error

    try:
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            headers = {_array_name(part.filename, path): _header(archive, part) for part in archive.infolist()}
    except MadocError:
        raise
    except _UNREADABLE as error:
        raise _damaged(path, error, remedy) from error
    return {name: Stored(*header, partial(read, name)) for name, header in headers.items()}


def _array_name(member: str, path: Path) -> str:
    """Name of the array that a member of an archive holds."""
    if not member.endswith(".npy"):
        raise MadocError(f"expected only arrays in {path}, got the file {member!r}; give an archive of arrays alone")
    return member.removesuffix(".npy")


def _header(archive: zipfile.ZipFile, part: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype, int]:
    """Shape, kind of values and size in bytes of one array; a ValueError says what is wrong with it."""
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
    return tuple(shape), dtype, size


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


@contextmanager
def opened(path: Path, remedy: str) -> Iterator[h5py.File]:
    """An HDF5 file for a block; what is wrong with it is one sentence, which ends with the remedy.

    Raises:
        MadocError: The file is missing, damaged, or has values in other files.
    """
    require_file(path)
    try:
        with h5py.File(path, "r") as file:
            _require_own_values(file, path)
            yield file
    except MadocError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, SystemError) as error:
        raise MadocError(f"cannot read {path} as HDF5 ({' '.join(str(error).split())}); {remedy}") from error


def size_of(dataset: h5py.Dataset) -> int:
    """Size in memory in bytes of a data set, or of one of its chunks where that is larger."""
    values = max(math.prod(dataset.shape or ()), math.prod(dataset.chunks or ()))
    return values * dataset.dtype.itemsize


def read_values(dataset: h5py.Dataset) -> np.ndarray:
    """All values of a data set. Text of any length is read in parts, as its size is not known before.

    Raises:
        MadocError: The text is larger than `LARGEST`.
    """
    if h5py.check_string_dtype(dataset.dtype) is None or dataset.dtype.kind != "O" or not dataset.ndim:
        return np.asarray(dataset[()])
    longest = max(1, dataset.file.id.get_filesize())  # no text of the file is longer
    rows = max(1, LARGEST // longest)
    parts, size = [], 0
    for start in range(0, len(dataset), rows):
        parts.append(np.asarray(dataset[start : start + rows]))
        size += sum(len(text) for text in parts[-1].ravel())
        check_size(size, f"the text {dataset.name}", LARGEST)
    return np.concatenate(parts) if parts else np.empty(dataset.shape, dtype=object)


def _require_own_values(file: h5py.File, path: Path) -> None:
    """Refuse links to other files, and data sets whose values lie in others."""

    def elsewhere(name: str, item: object) -> str | None:
        external = isinstance(item, h5py.Dataset) and (item.external or item.is_virtual)
        return name if external or isinstance(item, h5py.ExternalLink) else None

    found = file.visititems_links(elsewhere) or file.visititems(elsewhere)
    if found is not None:
        raise MadocError(f"{path} has {found!r} in another file, which is not read; copy its values into this one")
