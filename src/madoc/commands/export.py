"""`madoc export`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from madoc.commands.answer import Answer, Output
from madoc.pipeline.orders import Permission


@dataclass(frozen=True)
class Export:
    """Leave a calibration as files that other tools read.

    The model as MJCF, the patch of what changed with units, intervals and where they come from, ranges to
    randomize in, and parameters for mujoco.sysid.
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
        return Answer({"files": {what: str(path) for what, path in files.items()}}, lines)
