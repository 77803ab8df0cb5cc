"""Calibrators: from logged data to parameters. One file or folder a method; `CALIBRATORS` finds them by name."""

from madoc.calibration.base import CalibrationProblem as CalibrationProblem
from madoc.calibration.base import Calibrator as Calibrator
from madoc.calibration.base import Estimate as Estimate
from madoc.calibration.baselines.cma_es import CmaEs as CmaEs
from madoc.calibration.baselines.droid import Droid as Droid
from madoc.calibration.baselines.dropo import Dropo as Dropo
from madoc.calibration.baselines.npe.calibrator import Npe as Npe
from madoc.calibration.baselines.oted import Oted as Oted
from madoc.calibration.baselines.uncalibrated import Uncalibrated as Uncalibrated
from madoc.calibration.calibrate import calibrate as calibrate
from madoc.calibration.least_squares.calibrator import LeastSquares as LeastSquares
from madoc.calibration.madoc.calibrator import Madoc as Madoc
from madoc.calibration.registry import CALIBRATORS as CALIBRATORS
from madoc.calibration.result import CalibrationResult as CalibrationResult
from madoc.calibration.result import ParameterEstimate as ParameterEstimate
