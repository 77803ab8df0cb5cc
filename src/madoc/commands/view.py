"""`madoc view`."""

import contextlib
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from madoc.commands.answer import Answer, Output
from madoc.errors import MadocError
from madoc.pipeline.orders import Permission


@dataclass(frozen=True)
class View:
    """Show the held-out runs of a calibration in a browser: the robot in three dimensions, signals, and a time slider.

    The viewer is Rerun's and comes from this machine; whoever reaches the two ports sees the runs. Ctrl-C ends it.
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run folder with a finished calibration and a hold-out."""
    port: int = 9090
    """Port of the viewer; what it shows comes from the port after it."""
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Serve until Ctrl-C."""
        from madoc.pipeline import view_run

        if not 1 <= self.port <= 65534:
            raise MadocError(f"expected a port from 1 to 65534, got {self.port}")
        address, kept = view_run(self.folder, port=self.port, permission=self.permission)
        print(f"open {address}\nCtrl-C ends it", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()
        return Answer({"address": address, "runs": len(kept)}, ())
