"""`madoc report`, `madoc view` and `madoc export`: what is made of a run that is there."""

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
class Report:
    """Show a run as one HTML page, or several runs side by side.

    The page holds all it needs: it opens without a network, and can be sent as it is.
    """

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN")]
    """Run folders; of several, the page compares them."""
    out: Path | None = None
    """The page. Default: report.html in the run folder; of several runs, comparison.html here."""
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Write the page."""
        from madoc.pipeline import leave_motion
        from madoc.report import write_comparison, write_report

        if not self.runs:
            raise MadocError("expected a run folder to show; name one, as runs/hopper-medium, or several to compare")
        one = len(self.runs) == 1
        if one:
            leave_motion(self.runs[0], permission=self.permission)
        page = write_report(self.runs[0], self.out) if one else write_comparison(self.runs, self.out)
        return Answer({"page": str(page), "runs": [str(run) for run in self.runs]}, (f"report: {page}",))


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


@dataclass(frozen=True)
class Export:
    """Leave a calibration as files that other tools read.

    The model as MJCF, the patch of what changed with units, intervals and where they come from, ranges to
    randomize in, draws of whole models for Gymnasium, MuJoCo and MJX (Playground), the robot for mjlab and for
    Isaac Lab, drives for BAM, and parameters for mujoco.sysid. The first lines of the robot's files name what these
    cannot say.
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run folder with a finished calibration."""
    out: Path | None = None
    """Folder for the files. Default: export in the run folder."""
    onnx: bool = False
    """Write the run's policies as ONNX too; needs the package onnx."""
    rerun: bool = False
    """Write each held-out run for the viewer Rerun too: signals and the robot; needs the package rerun-sdk."""
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Write the files."""
        from madoc.pipeline import export_run

        files = export_run(self.folder, self.out, onnx=self.onnx, rerun=self.rerun, permission=self.permission)
        lines = tuple(f"{what}: {path}" for what, path in files.items())
        if "robot for mjlab" not in files:
            lines += ("no robot for mjlab and Isaac Lab, as they, and draws.py, leave out what drives.py computes",)
        return Answer({"files": {what: str(path) for what, path in files.items()}}, lines)
