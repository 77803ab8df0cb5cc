"""Every policy learner by the name that `madoc methods` lists."""

from madoc.policies.base import PolicyLearner
from madoc.policies.bc import BC
from madoc.policies.cql import CQL
from madoc.policies.fast_sac import FastSAC
from madoc.policies.h2o import H2O
from madoc.policies.morec import MOREC
from madoc.policies.sac import SAC
from madoc.types import MethodEntry

CLONING_WEIGHT = 2.5
"""Weight of SAC's loss beside the cloning error: TD3+BC's."""
_SAC_SHOWN = ("return_in_simulator", "temperature")

_ENTRIES: tuple[MethodEntry[PolicyLearner], ...] = (
    MethodEntry(
        "sac",
        SAC,
        "SAC in the calibrated simulator",
        "Haarnoja et al., SAC",
        2018,
        shown=_SAC_SHOWN,
        needs_data=False,
    ),
    MethodEntry(
        "fast-sac",
        FastSAC,
        "SAC for cheap simulation: the least wall time",
        "Seo et al., FastTD3",
        2025,
        shown=_SAC_SHOWN,
        needs_data=False,
    ),
    MethodEntry(
        "fast-sac-logged",
        FastSAC,
        "fast-sac, half of each batch from the log",
        "Ball et al., RLPD",
        2023,
        {"logged_share": 0.5},
        shown=_SAC_SHOWN,
    ),
    MethodEntry(
        "sac-bc",
        SAC,
        "SAC, cloning the data's actions too",
        "Jiang et al., Madoc",
        2024,
        {"cloning": CLONING_WEIGHT},
        shown=_SAC_SHOWN,
    ),
    MethodEntry(
        "dr-bc",
        SAC,
        "SAC over the whole box, cloning the data",
        "Tobin et al., randomization",
        2017,
        {"cloning": CLONING_WEIGHT, "randomize": True},
        shown=_SAC_SHOWN,
        needs_parameters=False,
    ),
    MethodEntry(
        "bc",
        BC,
        "clones the data's policy",
        "Pomerleau, ALVINN",
        1988,
        shown=("cloning_loss",),
        unit="updates",
        simulates=False,
        needs_parameters=False,
    ),
    MethodEntry(
        "cql",
        CQL,
        "conservative values, from the data alone",
        "Kumar et al., CQL",
        2020,
        shown=("conservative_gap", "value_target", "temperature"),
        unit="updates",
        simulates=False,
        needs_parameters=False,
    ),
    MethodEntry(
        "morec",
        MOREC,
        "a learnt model, kept to what looks real",
        "Luo et al., MOREC",
        2024,
        shown=("model_error", "dynamics_reward", "value_target"),
        unit="updates",
        simulates=False,
        needs_parameters=False,
    ),
    MethodEntry(
        "h2o",
        H2O,
        "SAC on logged and trusted simulated rows",
        "Niu et al., H2O",
        2022,
        shown=("return_in_simulator", "dynamics_ratio", "value_target"),
    ),
)

LEARNERS: dict[str, MethodEntry[PolicyLearner]] = {entry.name: entry for entry in _ENTRIES}
