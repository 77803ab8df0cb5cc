"""Every calibrator by the name that `madoc methods` lists."""

from madoc.calibration.base import Calibrator
from madoc.calibration.baselines.cma_es.calibrator import CmaEs
from madoc.calibration.baselines.droid import Droid
from madoc.calibration.baselines.dropo.calibrator import ENTROPY_WEIGHT, Dropo
from madoc.calibration.baselines.oted.calibrator import Oted
from madoc.calibration.baselines.uncalibrated import Uncalibrated
from madoc.calibration.least_squares.calibrator import LeastSquares
from madoc.calibration.madoc.calibrator import PAPER, Madoc
from madoc.types import MethodEntry


def _madoc(name: str, summary: str, **settings: str) -> MethodEntry[Calibrator]:
    return MethodEntry(name, Madoc, summary, "Jiang et al., Madoc", 2024, settings, shown=_MADOC_SHOWN)


_MADOC_SHOWN = ("mismatch", "accuracy_sas", "cloning_loss")
_CMA_ES_SHOWN = ("cost", "deviation", "cloning_loss")
_DROPO_SHOWN = ("cost", "std", "deviation")

_ENTRIES: tuple[MethodEntry[Calibrator], ...] = (
    _madoc("madoc", "one agent a group of parameters, DOP"),
    _madoc("madoc-s", "one agent for all parameters", groups="one"),
    _madoc("madoc-vdn", "credit by a plain sum (VDN)", mixing="sum"),
    _madoc("madoc-isac", "agents share one reward, no credit", mixing="independent"),
    _madoc("madoc-ungrouped", "one agent a parameter", groups="each"),
    MethodEntry(
        "madoc-paper",
        Madoc,
        "Madoc with the paper's own constants",
        "Jiang et al., Madoc",
        2024,
        PAPER,
        recognised_by=("features", "keep_cloning"),
        shown=_MADOC_SHOWN,
    ),
    MethodEntry(
        "least-squares",
        LeastSquares,
        "damped Gauss-Newton, robust, with intervals",
        "Levenberg; Marquardt",
        1963,
        shown=("residual", "moved"),
    ),
    MethodEntry(
        "oted",
        Oted,
        "matches (s, a) by a bandit's policy gradient",
        "Gur et al. (from its abstract)",
        2021,
        shown=("reward", "std", "cloning_loss"),
    ),
    MethodEntry(
        "dropo",
        Dropo,
        "distribution that makes next states likely",
        "Tiboni et al., DROPO",
        2022,
        shown=_DROPO_SHOWN,
    ),
    MethodEntry(
        "e-dropo",
        Dropo,
        "DROPO with an entropy bonus",
        "Fickinger et al., E-DROPO",
        2025,
        {"entropy_weight": ENTROPY_WEIGHT},
        shown=_DROPO_SHOWN,
    ),
    MethodEntry(
        "droid",
        Droid,
        "replayed windows, CMA-ES, its covariance",
        "Tsai et al., DROID",
        2021,
        shown=("cost", "deviation"),
    ),
    MethodEntry(
        "cma-es",
        CmaEs,
        "one-step error, black box: a yardstick",
        "Hansen and Ostermeier, CMA-ES",
        2001,
        shown=_CMA_ES_SHOWN,
    ),
    MethodEntry(
        "cma-es-distribution",
        CmaEs,
        "distance of unordered observations",
        "after arXiv 2604.11090",
        2026,
        {"objective": "distribution"},
        shown=_CMA_ES_SHOWN,
    ),
    MethodEntry(
        "nominal",
        Uncalibrated,
        "mid-range, uncalibrated: a yardstick",
        "no paper: a yardstick",
        2024,
        simulates=False,
    ),
    MethodEntry(
        "uniform",
        Uncalibrated,
        "the whole box as randomization",
        "Tobin et al., randomization",
        2017,
        {"randomised": True},
        simulates=False,
    ),
)

CALIBRATORS: dict[str, MethodEntry[Calibrator]] = {entry.name: entry for entry in _ENTRIES}
