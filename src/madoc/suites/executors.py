"""Who starts the workers of a suite: this machine, or a Ray cluster.

Here processes are started again where one is killed, and ended with the suite. Ray chooses the process, and the process
is the worker of `madoc worker`: a cell is a task of one CPU, and where its process or its machine is lost, Ray starts
the task again elsewhere, and the worker goes on from the cell's checkpoint. The folder of the suite has to be seen by
all machines of the cluster.
"""

import logging
import os
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from madoc.errors import MadocError, needing
from madoc.pipeline.orders import NO_PERMISSION, Permission
from madoc.runs.machine import prepare_worker, usable_cores
from madoc.runs.progress import display, interruptible
from madoc.suites.claims import MOST_ATTEMPTS
from madoc.suites.standing import Standing

if TYPE_CHECKING:
    from types import ModuleType

_LOOK = 0.5
"""Time in s between two looks at the disk."""
_MANY = 5000
"""Number of cells for which that time is twice as long: looking should not take a core from the workers."""
_FUTILE = 5
"""How many workers in a row may end with an error before any cell has ended: then something is wrong with all."""
_WAIT = 30.0
"""Time in s that a task waits for a cell whose earlier process has not quite ended."""
_LONGEST_PATH = 18
"""Longest path of a temporary directory in which Ray's sockets can be made."""
_OBJECT_STORE = 80 * 2**20
"""Memory for Ray's object store in bytes: only names of cells pass through it."""


def run_locally(
    suite: Path,
    standing: Standing,
    *,
    plan: str,
    workers: int,
    quiet: bool = False,
    permission: Permission = NO_PERMISSION,
) -> bool:
    """Do what is left of a plan with so many processes; whether all was done, False where it was interrupted.

    Raises:
        MadocError: No worker can be started.
    """
    with (
        interruptible() as interruption,
        display(suite.name, unit="cells", quiet=quiet) as show,
        closing(Crew(suite, plan, min(workers, len(standing.runnable)), permission=permission)) as crew,
    ):
        while standing.runnable:
            show(standing.moment())
            if interruption.asked:
                with interruption.breakable():
                    crew.stop()
                standing.look()
                return not standing.runnable
            time.sleep(_LOOK * (1 + len(standing.left) / _MANY))
            crew.replace_dead(progressed=standing.look() > 0)
        show(standing.moment())
    return True


class Crew:
    """The processes of some workers; each writes to a log of its own in the suite's folder."""

    def __init__(self, suite: Path, plan: str, workers: int, *, permission: Permission = NO_PERMISSION) -> None:
        self._suite, self._plan, self._futile, self._permission = suite, plan, 0, permission
        self._logs = suite / "logs"
        self._logs.mkdir(exist_ok=True)
        self._processes = {number: self._start(number) for number in range(workers)}

    def replace_dead(self, *, progressed: bool) -> None:
        """Start a worker again for each that was killed, and one if all have left and there is still something to do.

        Raises:
            MadocError: Workers end with errors and nothing gets done.
        """
        ended = {number: process.poll() for number, process in self._processes.items()}
        left = [number for number, code in ended.items() if code == 0]
        if progressed:
            self._futile = 0
        for number, code in ended.items():
            if code is None or (code == 0 and len(left) < len(ended)):
                continue
            self._futile += code > 0
            if self._futile >= _FUTILE:
                raise MadocError(f"{_FUTILE} workers ended with an error; the last said: {self._last_words(number)}")
            self._processes[number] = self._start(number)
            if code == 0:
                break  # what is left is held by others: one of ours looks whether that changes

    def stop(self) -> None:
        """Ask all to stop after their present step, and wait until they have."""
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            process.wait()

    def close(self) -> None:
        """End all at once, if they have not ended."""
        for process in self._processes.values():
            process.kill()
            process.wait()
            if process.stdin:
                process.stdin.close()

    def _start(self, number: int) -> subprocess.Popen[bytes]:
        # Its standard input is our end of a pipe that says nothing: it closes when we end, however that happens.
        # A session of its own keeps Ctrl-C for us alone: we pass it on once.
        words = [sys.executable, "-m", "madoc", "worker", str(self._suite), "--attached", "--quiet"]
        words += [f"--plan={self._plan}"]
        words += self._permission.words
        with (self._logs / f"worker-{number}.log").open("ab") as log:
            return subprocess.Popen(
                words,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def _last_words(self, number: int) -> str:
        lines = (self._logs / f"worker-{number}.log").read_text(errors="replace").strip().splitlines()
        return lines[-1].removeprefix("madoc: ") if lines else "nothing"


def run_on_ray(
    suite: Path,
    standing: Standing,
    *,
    plan: str,
    workers: int | None,
    address: str | None,
    quiet: bool = False,
    permission: Permission = NO_PERMISSION,
) -> bool:
    """Do what is left of a plan on a Ray cluster; whether all was done, False where it was interrupted.

    Without the `address` of a cluster, one is started on this machine for so many `workers`, and ended afterwards.

    Raises:
        MadocError: Ray is not installed, or there is no cluster at the address.
    """
    with (
        interruptible() as interruption,
        _cluster(workers, address) as ray,
        display(f"{suite.name} on Ray", unit="cells", quiet=quiet) as show,
    ):
        tasks = _Tasks(ray, suite.resolve(), plan, permission=permission)
        while standing.runnable:
            show(standing.moment())
            if interruption.asked:
                tasks.cancel()
                standing.look()
                return not standing.runnable
            tasks.keep_up(standing)
            standing.look()
        show(standing.moment())
    return True


def do_cell(suite: str, name: str, plan: str, permission: Permission = NO_PERMISSION) -> str:
    """One task: do a cell in a process of the cluster; how it ended, empty where another process still holds it."""
    prepare_worker()
    from madoc.suites.worker import work  # computes numbers, on the core that was taken

    until = time.monotonic() + _WAIT
    while time.monotonic() < until:
        done = work(Path(suite), [name], plan=plan, permission=permission)
        if done is None:
            return "interrupted"
        if done:
            return done[0].status
        time.sleep(1.0)  # the process of an earlier attempt is about to end, or has just ended the cell
        if (Path(suite) / "cells" / name / "outcome.json").exists():
            return "ended"
    return ""


class _Tasks:
    """The tasks of a suite that Ray has been given."""

    def __init__(self, ray: "ModuleType", suite: Path, plan: str, *, permission: Permission = NO_PERMISSION) -> None:
        self._ray, self._suite, self._plan, self._permission = ray, str(suite), plan, permission
        self._do = ray.remote(num_cpus=1, max_retries=MOST_ATTEMPTS)(do_cell)
        self._given: dict[str, Any] = {}

    def keep_up(self, standing: Standing) -> None:
        """Give Ray every cell that can start, and again one whose task ended without an end of the cell."""
        for cell in standing.runnable:
            if cell.name not in self._given and (cell.needs is None or cell.needs in standing.ended):
                self._given[cell.name] = self._do.remote(self._suite, cell.name, self._plan, self._permission)
        if not self._given:
            time.sleep(_LOOK)
            return
        names = {reference: name for name, reference in self._given.items()}
        over, _ = self._ray.wait(list(names), num_returns=1, timeout=_LOOK)
        for reference in over:
            del self._given[names[reference]]
            try:
                self._ray.get(reference)
            except self._ray.exceptions.RayTaskError as error:
                last = str(error).strip().splitlines()[-1]
                raise MadocError(
                    f"the worker on the cluster ended with an error: {last}; is Madoc installed there?"
                ) from error
            except self._ray.exceptions.RayError:
                continue  # its process was lost more often than Ray tries; the claim counts how often it got no further

    def cancel(self) -> None:
        """Take back every task."""
        for reference in self._given.values():
            self._ray.cancel(reference, force=True)


@contextmanager
def _cluster(workers: int | None, address: str | None) -> Iterator["ModuleType"]:
    """Ray, connected to a cluster for a block."""
    if address is not None:
        _look_for(address)
    temporary = Path(tempfile.mkdtemp(prefix="madoc-ray-", dir=_short_folder()))  # of mode 0700
    # Read by Ray when it is imported and by all processes it starts. A cluster of one's own lets in only who knows its
    # token, which stands in no file, and listens to this machine alone: on Linux, Ray takes an address that others
    # reach for a loopback address, unless it is told as on other systems that there are no others.
    own = {
        "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        "RAY_worker_niceness": "0",  # a cell is what the machine is for
    }
    before = {name: os.environ.get(name) for name in own}
    if address is None:
        os.environ.update(own)
    try:
        with needing("--executor ray needs ray:", "madoc-calibration[ray]"):
            import ray
        common: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR, "configure_logging": False}
        if address is None:
            common |= {
                "num_cpus": workers or usable_cores(),
                "include_dashboard": False,
                "_node_ip_address": "127.0.0.1",
                "object_store_memory": _OBJECT_STORE,
                "_temp_dir": str(temporary / "r"),  # which Ray opens to all users
            }
        try:
            ray.init(address=address, **common)
        except (ConnectionError, RuntimeError, ValueError) as error:
            reason = " ".join(str(error).split())[:300]
            raise MadocError(f"there is no Ray cluster at {address or 'this machine'}: {reason}") from error
        try:
            yield ray
        finally:
            ray.shutdown()
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})
        shutil.rmtree(temporary, ignore_errors=True)


def _short_folder() -> str | None:
    """Where Ray's files may lie: a socket's path has at most 103 characters, of which Ray needs 67; None is usual."""
    return "/tmp" if len(tempfile.gettempdir()) > _LONGEST_PATH and os.path.isdir("/tmp") else None


def _look_for(address: str) -> None:
    """Refuse an address at which nobody listens: Ray itself would wait for a minute, and end this process."""
    host, _, port = address.rpartition(":")
    if host and port.isdecimal() and "/" not in host:
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=10.0).close()
        except OSError as error:
            reason = error.strerror or str(error)
            raise MadocError(f"there is no Ray cluster at {address}: {reason}; start one with: ray start") from error
