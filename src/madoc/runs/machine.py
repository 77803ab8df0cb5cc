"""What this process may use of its machine: its cores, and folders that belong to its user alone."""

import contextlib
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from threadpoolctl import threadpool_limits


def usable_cores() -> int:
    """Number of cores that this process may use; all of the machine where the system knows no affinity."""
    return len(choosable_cores()) or os.cpu_count() or 1


def choosable_cores() -> list[int]:
    """Numbers of the cores that this process may keep itself to; none where the system knows no affinity (macOS)."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def keep_to_core(core: int) -> None:
    """Keep this process to one of the cores that it can choose."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Products of matrices in this process on one thread: the same bits on any number of cores.

    Those of windows are small. A second thread saves little of their time, and costs several times as much where it
    has to wait for a core. It is a decorator too.
    """
    import scipy.linalg  # noqa: F401  its BLAS is another than NumPy's, and is limited only once it is loaded

    with threadpool_limits(1, user_api="blas"):
        yield


def own_folder(*parts: str) -> Path | None:
    """A folder that only this user can read and write, made if it is not there.

    It is in `madoc` of the user's cache (XDG_CACHE_HOME or ~/.cache), or in the temporary directory where that cannot
    be written; None where neither is the user's own.
    """
    for root in _roots():
        folder = root.joinpath(*parts)
        try:
            root.parent.mkdir(parents=True, exist_ok=True)
            if _made_private(root):
                folder.mkdir(mode=0o700, parents=True, exist_ok=True)
                return folder
        except OSError:
            continue
    return None


def _roots() -> Iterator[Path]:
    """Where such a folder may be."""
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    with contextlib.suppress(RuntimeError):  # a user of a container may have neither a name nor a home
        yield (named if named.is_absolute() else Path.home() / ".cache") / "madoc"
    yield Path(tempfile.gettempdir()) / f"madoc-{_user()}"


def _user() -> int:
    """Number of the user; 0 where the system has none."""
    return os.getuid() if hasattr(os, "getuid") else 0


def _made_private(folder: Path) -> bool:
    """Make a folder that others cannot enter; whether it is one, and ours, and no link to another."""
    folder.mkdir(mode=0o700, exist_ok=True)
    state = folder.lstat()
    if os.name != "posix":
        return True
    if not stat.S_ISDIR(state.st_mode) or state.st_uid != _user():
        return False
    if stat.S_IMODE(state.st_mode) & 0o077:
        folder.chmod(0o700)
    return True
