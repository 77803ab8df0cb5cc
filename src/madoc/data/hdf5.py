"""HDF5 files, whose values have to lie in the file itself: one that names others is refused before it is read."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from madoc.data.sizes import LARGEST, check_size
from madoc.data.validation import require_file
from madoc.errors import MadocError


@contextmanager
def opened(path: Path, remedy: str) -> Iterator[h5py.File]:
    """A file for a block; what is wrong with it is one sentence, which ends with the remedy.

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
