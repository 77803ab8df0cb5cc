"""The worker processes of this machine: started, started again where one is killed, and ended with the suite."""

import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

from madoc.errors import MadocError
from madoc.pipeline.orders import NO_PERMISSION, Permission
from madoc.runs.progress import display, interruptible
from madoc.suites.standing import Standing

_LOOK = 0.5
"""Time in s between two looks at the disk."""
_MANY = 5000
"""Number of cells for which that time is twice as long: looking should not take a core from the workers."""
_FUTILE = 5
"""How many workers in a row may end with an error before any cell has ended: then something is wrong with all."""


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
