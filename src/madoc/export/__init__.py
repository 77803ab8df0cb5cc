"""A calibration out of Madoc: the model, what changed in it, ranges to randomize in, a policy for other runtimes."""

from madoc.export.draws import save_draws
from madoc.export.onnx_policy import save_onnx
from madoc.export.parameter_files import (
    Exported,
    bam_files,
    is_patch,
    save_bam,
    save_patch,
    save_randomization,
    save_sysid_parameters,
)
from madoc.export.recording import save_recordings, serve_recordings
from madoc.export.trainers import Robot, save_isaac_lab, save_mjlab

__all__ = [
    "Exported",
    "Robot",
    "bam_files",
    "is_patch",
    "save_bam",
    "save_draws",
    "save_isaac_lab",
    "save_mjlab",
    "save_onnx",
    "save_patch",
    "save_randomization",
    "save_recordings",
    "save_sysid_parameters",
    "serve_recordings",
]
