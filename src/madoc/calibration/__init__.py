"""Calibrators: from logged data to parameters. One file or folder a method; `CALIBRATORS` finds them by name."""

from madoc.calibration.base import CalibrationProblem, Calibrator, Estimate
from madoc.calibration.baselines.cma_es.calibrator import CmaEs
from madoc.calibration.baselines.droid import Droid
from madoc.calibration.baselines.dropo.calibrator import Dropo
from madoc.calibration.baselines.oted.calibrator import Oted
from madoc.calibration.baselines.uncalibrated import Uncalibrated
from madoc.calibration.calibrate import calibrate
from madoc.calibration.least_squares.calibrator import LeastSquares
from madoc.calibration.madoc.calibrator import Madoc
from madoc.calibration.registry import CALIBRATORS
from madoc.calibration.result import CalibrationResult, ParameterEstimate

__all__ = [
    "CALIBRATORS",
    "CalibrationProblem",
    "CalibrationResult",
    "Calibrator",
    "CmaEs",
    "Droid",
    "Dropo",
    "Estimate",
    "LeastSquares",
    "Madoc",
    "Oted",
    "ParameterEstimate",
    "Uncalibrated",
    "calibrate",
]
