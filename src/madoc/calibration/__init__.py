"""Calibrators: from logged data to parameters. One file a method; `CALIBRATORS` finds them by name."""

from functools import partial

from madoc.calibration.base import CalibrationProblem, Calibrator, Estimate
from madoc.calibration.baselines.cma_es.calibrator import CmaEs
from madoc.calibration.baselines.droid import Droid
from madoc.calibration.baselines.dropo.calibrator import ENTROPY_WEIGHT, Dropo
from madoc.calibration.baselines.oted.calibrator import Oted
from madoc.calibration.baselines.uncalibrated import Uncalibrated
from madoc.calibration.calibrate import calibrate
from madoc.calibration.least_squares.calibrator import LeastSquares
from madoc.calibration.madoc.calibrator import Madoc
from madoc.calibration.result import CalibrationResult, ParameterEstimate
from madoc.types import MethodEntry

_PAPER = "Jiang et al., Madoc"


CALIBRATORS: dict[str, MethodEntry[Calibrator]] = {
    "madoc": MethodEntry(Madoc, "one agent a group of parameters, DOP", _PAPER, 2024),
    "madoc-s": MethodEntry(partial(Madoc, groups="one"), "one agent for all parameters", _PAPER, 2024),
    "madoc-vdn": MethodEntry(partial(Madoc, mixing="sum"), "credit by a plain sum (VDN)", _PAPER, 2024),
    "madoc-isac": MethodEntry(partial(Madoc, mixing="independent"), "agents share one reward, no credit", _PAPER, 2024),
    "madoc-ungrouped": MethodEntry(partial(Madoc, groups="each"), "one agent a parameter", _PAPER, 2024),
    "madoc-paper": MethodEntry(Madoc.paper, "Madoc with the paper's own constants", _PAPER, 2024),
    "least-squares": MethodEntry(
        LeastSquares, "damped Gauss-Newton, robust, with intervals", "Levenberg; Marquardt", 1963
    ),
    "oted": MethodEntry(Oted, "matches (s, a) by a bandit's policy gradient", "Gur et al. (from its abstract)", 2021),
    "dropo": MethodEntry(Dropo, "distribution that makes next states likely", "Tiboni et al., DROPO", 2022),
    "e-dropo": MethodEntry(
        partial(Dropo, entropy_weight=ENTROPY_WEIGHT), "DROPO with an entropy bonus", "Fickinger et al., E-DROPO", 2025
    ),
    "droid": MethodEntry(Droid, "replayed windows, CMA-ES, its covariance", "Tsai et al., DROID", 2021),
    "cma-es": MethodEntry(CmaEs, "one-step error, black box: a yardstick", "Hansen and Ostermeier, CMA-ES", 2001),
    "cma-es-distribution": MethodEntry(
        partial(CmaEs, "distribution"),
        "distance of unordered observations",
        "after arXiv 2604.11090",
        2026,
    ),
    "nominal": MethodEntry(Uncalibrated, "mid-range, uncalibrated: a yardstick", "no paper: a yardstick", 2024),
    "uniform": MethodEntry(
        partial(Uncalibrated, randomised=True),
        "the whole box as randomization",
        "Tobin et al., randomization",
        2017,
    ),
}

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
