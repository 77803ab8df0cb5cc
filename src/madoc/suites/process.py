"""What a worker process sets for itself before it computes: a core of its own, and where compiled code is kept."""

import os
import platform
import tempfile
from pathlib import Path

import filelock

_held: list[filelock.BaseFileLock] = []
"""The lock of this process's core, held until it ends."""


def prepare(suite: Path) -> None:
    """Take a core, and let workers of this machine share what they compile; to be called before JAX is imported.

    Machines of a cluster may differ in their instructions, so each has a folder for compiled code of its own.
    """
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(suite.resolve() / "compiled" / platform.node()))
    take_core()


def take_core() -> None:
    """Keep this process to a core that no other worker of this machine has, by a lock that ends with the process.

    A core decides how fast a cell is, not what it finds. None is taken where there is no choice: one core only, all
    taken, or a system without affinity.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if _held or not hasattr(os, "sched_setaffinity"):
        return
    cores = sorted(os.sched_getaffinity(0))
    folder = Path(tempfile.gettempdir()) / f"madoc-cores-{os.getuid()}"  # in a container it may have no name
    folder.mkdir(mode=0o700, exist_ok=True)
    for core in cores if len(cores) > 1 else ():
        lock = filelock.FileLock(folder / f"{core}.lock", timeout=0, thread_local=False)
        try:
            lock.acquire()
        except filelock.Timeout:
            continue
        _held.append(lock)
        os.sched_setaffinity(0, {core})
        return
