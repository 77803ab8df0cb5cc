"""Reading of npz archives without unpickling; a damaged archive is refused."""

import zipfile
import zlib
from pathlib import Path

import numpy as np
from numpy.lib.npyio import NpzFile

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
    """Every array of a log by name; one that is missing, damaged or holds Python objects is refused."""
    require_file(path)
    if not _is_npz(path):
        raise MadocError(f"{path} is not an npz file; pass the --format it has")
    return unpack(path)


def unpack(path: Path, remedy: str = MAKE_AGAIN) -> dict[str, np.ndarray]:
    """Every array of an archive by name.

    Raises:
        MadocError: The archive is damaged, or holds anything but arrays; its sentence ends with the remedy.
    """
    try:
        with path.open("rb") as file, NpzFile(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except _UNREADABLE as error:
        raise _damaged(path, error, remedy) from error
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray):  # NumPy returns other members of a zip archive as bytes
            raise MadocError(f"expected only arrays in {path}, got the file {name!r}; give an archive of arrays alone")
    return arrays


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
