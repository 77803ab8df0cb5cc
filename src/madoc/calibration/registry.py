"""Every calibrator by the name that `madoc methods` lists."""

from dataclasses import replace
from typing import Any

from madoc.calibration.base import Calibrator
from madoc.calibration.baselines.cma_es import CmaEs
from madoc.calibration.baselines.droid import Droid
from madoc.calibration.baselines.dropo import ENTROPY_WEIGHT, Dropo
from madoc.calibration.baselines.npe.calibrator import Npe
from madoc.calibration.baselines.oted import Oted
from madoc.calibration.baselines.uncalibrated import Uncalibrated
from madoc.calibration.least_squares.calibrator import LeastSquares
from madoc.calibration.madoc.calibrator import PAPER, Madoc
from madoc.types import MethodEntry

_SHOWN: dict[type, tuple[str, ...]] = {
    Madoc: ("mismatch", "accuracy_sas", "cloning_loss"),
    LeastSquares: ("residual", "moved"),
    Oted: ("reward", "std", "cloning_loss"),
    Dropo: ("cost", "std", "deviation"),
    Droid: ("cost", "deviation"),
    CmaEs: ("cost", "deviation", "cloning_loss"),
    Npe: ("width", "misfit", "cloning_loss"),
    Uncalibrated: (),
}
"""Metrics beside the progress bar, by class of the method."""

_MADOC = "Jiang et al., Madoc"


_ENTRIES: tuple[MethodEntry[Calibrator[Any]], ...] = (
    MethodEntry("madoc", Madoc, "one agent a parameter; needs no states", _MADOC, 2024),
    MethodEntry("madoc-s", Madoc, "one agent for all parameters", _MADOC, 2024, {"groups": "one"}),
    MethodEntry("madoc-vdn", Madoc, "credit by a plain sum (VDN)", _MADOC, 2024, {"mixing": "sum"}),
    MethodEntry("madoc-isac", Madoc, "agents share one reward, no credit", _MADOC, 2024, {"mixing": "independent"}),
    MethodEntry("madoc-grouped", Madoc, "one agent a group, learned by the VAE", _MADOC, 2024, {"groups": "learned"}),
    MethodEntry(
        "madoc-paper", Madoc, "Madoc with the paper's own constants", _MADOC, 2024, PAPER, ("features", "keep_cloning")
    ),
    MethodEntry(
        "least-squares",
        LeastSquares,
        "damped Gauss-Newton, robust, with intervals",
        "Levenberg; Marquardt",
        1963,
        usual_budget="300s",  # it settles by itself, mostly within seconds
    ),
    MethodEntry("oted", Oted, "matches (s, a) by a bandit's policy gradient", "Gur et al. (from its abstract)", 2021),
    MethodEntry("dropo", Dropo, "distribution that makes next states likely", "Tiboni et al., DROPO", 2022),
    MethodEntry(
        "e-dropo",
        Dropo,
        "DROPO with an entropy bonus",
        "Fickinger et al., E-DROPO",
        2025,
        {"entropy_weight": ENTROPY_WEIGHT},
    ),
    MethodEntry("droid", Droid, "replayed windows, CMA-ES, its covariance", "Tsai et al., DROID", 2021),
    MethodEntry("cma-es", CmaEs, "one-step error, black box: a yardstick", "Hansen and Ostermeier, CMA-ES", 2001),
    MethodEntry(
        "cma-es-distribution",
        CmaEs,
        "distance of unordered observations",
        "after arXiv 2604.11090",
        2026,
        {"objective": "distribution"},
    ),
    MethodEntry("npe", Npe, "posterior by a flow, on free rollouts", "Deistler et al., TSNPE", 2022),
    MethodEntry("nominal", Uncalibrated, "mid-range, uncalibrated: a yardstick", "no paper: a yardstick", 2024),
    MethodEntry(
        "uniform",
        Uncalibrated,
        "the whole box as randomization",
        "Tobin et al., randomization",
        2017,
        {"randomised": True},
    ),
)

CALIBRATORS: dict[str, MethodEntry[Calibrator[Any]]] = {
    entry.name: replace(entry, shown=_SHOWN[entry.kind], simulates=entry.kind is not Uncalibrated) for entry in _ENTRIES
}
