"""What this process has of its machine: cores, memory, folders that belong to its user alone, versions of packages."""

import contextlib
import os
import platform
import re
import stat
import tempfile
import warnings
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import filelock
from threadpoolctl import threadpool_limits

from madoc.runs.files import read_json, write_json

PEAK = "memory.json"
"""Name of the file of a run folder that holds `peak_memory`, bytes; not there where it is not known. It has its own
file, as unlike the rest of a result it is another one in every run."""

_PROCESS = Path("/proc/self")
_PRESENT_SIZE = "5"
"""What sets the peak of the resident set back to its present size (proc(5), `clear_refs`; Linux 4.0 or later)."""
_PACKAGES = {"madoc": ("madoc-calibration",), "jax": ("jax",), "mujoco": ("mujoco-core", "mujoco")}
"""What results depend on, and where its version is found: since 4.0 MuJoCo's library is in a package of its own."""
_held: list[filelock.BaseFileLock] = []
"""The lock of this process's core, held until it ends."""


def usable_cores() -> int:
    """Number of cores that this process may use; all of the machine where the system knows no affinity."""
    return len(choosable_cores()) or os.cpu_count() or 1


def choosable_cores() -> list[int]:
    """Numbers of the cores that this process may keep itself to; none where the system knows no affinity (macOS)."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


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


def prepare_worker() -> None:
    """Take a core, and let workers of this machine share what they compile; to be called before JAX is imported.

    Compiled code is run as it is found, so it is kept where nobody else can write, and never in a suite's folder.
    Machines of a cluster may differ in their instructions, so each has a folder of its own.
    """
    compiled = own_folder("compiled", platform.node())
    if compiled is not None:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(compiled))
    # What another worker is just writing is compiled here as well.
    warnings.filterwarnings("ignore", "Error reading persistent compilation cache entry", UserWarning)
    take_core()


def take_core() -> None:
    """Keep this process to a core that no other worker of this machine has, by a lock that ends with the process.

    A core decides how fast a cell is, not what it finds. None is taken where there is no choice: one core only, all
    taken, a system without affinity, or no folder of the user's own for the locks.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cores = choosable_cores()
    if _held or len(cores) < 2:
        return
    folder = own_folder("cores", platform.node())
    if folder is None:
        return
    for core in cores:
        lock = filelock.FileLock(folder / f"{core}.lock", timeout=0, thread_local=False)
        try:
            lock.acquire()
        except filelock.Timeout:
            continue
        _held.append(lock)
        os.sched_setaffinity(0, {core})
        return


def forget_peak() -> bool:
    """Look for the peak from now on; whether the system can."""
    try:
        (_PROCESS / "clear_refs").write_text(_PRESENT_SIZE)
    except OSError:
        return False
    return True


def peak_memory() -> int | None:
    """The largest resident set of this process since `forget_peak`, bytes; None where the system does not tell."""
    try:
        told = (_PROCESS / "status").read_text()
    except OSError:
        return None
    peak = re.search(r"^VmHWM:\s+(\d+) kB$", told, re.MULTILINE)
    return None if peak is None else 1024 * int(peak[1])


def write_peak(folder: Path, peak: int | None) -> None:
    """Keep the peak of a run, bytes, in its folder; None where a part of the run has none that is known."""
    if peak is None:
        (folder / PEAK).unlink(missing_ok=True)
    else:
        write_json(folder / PEAK, {"peak_memory": peak})


def read_peak(folder: Path) -> int | None:
    """The peak of a run, bytes; None where it is not known."""
    file = folder / PEAK
    return int(read_json(file)["peak_memory"]) if file.exists() else None


def versions() -> dict[str, str]:
    """Versions of Python and of the packages on which the results of a run depend, by name."""
    installed = {"python": platform.python_version()}
    for name, packages in _PACKAGES.items():
        found = (_version(package) for package in packages)
        installed[name] = next((version for version in found if version), "not installed")
    return installed


def _version(package: str) -> str:
    """Version of an installed package, empty where there is none of that name."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""
