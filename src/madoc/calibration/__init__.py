"""Calibrators: from logged data to parameters. One file a method; `CALIBRATORS` finds them by name."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from madoc.calibration.base import CalibrationProblem, Calibrator, Estimate
from madoc.calibration.calibrate import calibrate
from madoc.calibration.madoc.calibrator import Madoc
from madoc.calibration.result import CalibrationResult, ParameterEstimate

_PAPER = "Jiang et al., Multi-Agent Domain Calibration with a Handful of Offline Data"


@dataclass(frozen=True)
class CalibratorEntry:
    """A line of `madoc methods`. `make` takes the method's hyperparameters as keywords."""

    make: Callable[..., Calibrator]
    summary: str
    paper: str
    year: int


CALIBRATORS: dict[str, CalibratorEntry] = {
    "madoc": CalibratorEntry(Madoc, "one agent a group of like parameters, credit by DOP", _PAPER, 2024),
    "madoc-s": CalibratorEntry(partial(Madoc, groups="one"), "one agent for all parameters", _PAPER, 2024),
    "madoc-vdn": CalibratorEntry(partial(Madoc, mixing="sum"), "credit by a plain sum (VDN)", _PAPER, 2024),
    "madoc-isac": CalibratorEntry(
        partial(Madoc, mixing="independent"), "every agent learns from the shared reward alone", _PAPER, 2024
    ),
    "madoc-ungrouped": CalibratorEntry(partial(Madoc, groups="each"), "one agent a parameter", _PAPER, 2024),
    "madoc-paper": CalibratorEntry(Madoc.paper, "Madoc with the paper's own constants", _PAPER, 2024),
}

__all__ = [
    "CALIBRATORS",
    "CalibrationProblem",
    "CalibrationResult",
    "Calibrator",
    "CalibratorEntry",
    "Estimate",
    "Madoc",
    "ParameterEstimate",
    "calibrate",
]
