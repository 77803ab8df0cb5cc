"""`madoc worker`."""

import os
import signal
import sys
import threading
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from madoc.commands.answer import Answer, Output
from madoc.pipeline.orders import Permission


@dataclass(frozen=True)
class Worker:
    """Do cells of a suite, one after another on one core, until none is left to begin.

    Start it as often as you like, on any machines that share the folder: each cell is done once. A cell whose worker
    was killed is gone on with by the next that comes.
    """

    folder: Annotated[Positional[Path], arg(metavar="SUITE")]
    """The folder of a suite, as `madoc suite` names it."""
    plan: str | None = None
    """Do only the cells of this plan: the name of a suite file, without .yaml. Default: of all in the folder."""
    attached: bool = False
    """Stop when standard input closes, as it does when the process that started this one ends."""
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Claim cells and do them."""
        from madoc.suites.process import prepare

        if self.attached:
            threading.Thread(target=_stop_at_end_of_input, daemon=True).start()
        prepare()
        from madoc.suites.worker import work  # computes numbers, on the core that was taken

        done = work(self.folder, plan=self.plan, permission=self.permission)
        if done is None:
            return Answer({"status": "interrupted"}, ("interrupted; the next worker goes on",), "interrupted")
        counts = Counter(outcome.status for outcome in done)
        told = ", ".join(f"{count} {status}" for status, count in counts.items()) or "there was nothing to begin"
        return Answer({"ended": dict(counts)}, (f"{len(done)} cells: {told}",))


def _stop_at_end_of_input() -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
