"""What a worker process sets for itself before it computes: a core of its own, and where compiled code is kept."""

import os
import platform
import warnings

import filelock

from madoc.runs.machine import choosable_cores, keep_to_core, own_folder

_held: list[filelock.BaseFileLock] = []
"""The lock of this process's core, held until it ends."""


def prepare() -> None:
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
        keep_to_core(core)
        return
