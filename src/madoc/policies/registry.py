"""Every policy learner by the name that `madoc methods` lists."""

from functools import partial
from typing import Any

from madoc.policies.base import PolicyLearner
from madoc.policies.bc import BC
from madoc.policies.cql import CQL
from madoc.policies.fast_sac import FastSAC
from madoc.policies.h2o import H2O
from madoc.policies.morec import MOREC
from madoc.policies.sac import SAC
from madoc.types import MethodEntry

CLONING = {"cloning": 2.5}
"""SAC+BC's weight of SAC's loss beside the cloning error: TD3+BC's."""

SAC_SHOWN = ("return_in_simulator", "temperature")

_sac = partial(MethodEntry[PolicyLearner[Any]], kind=SAC, shown=SAC_SHOWN)
_fast_sac = partial(MethodEntry[PolicyLearner[Any]], kind=FastSAC, shown=SAC_SHOWN, usual_budget=2_400_000)
_offline = partial(MethodEntry[PolicyLearner[Any]], unit="updates", simulates=False, needs_parameters=False)

_ENTRIES: tuple[MethodEntry[PolicyLearner[Any]], ...] = (
    _sac(
        name="sac",
        summary="SAC in the calibrated simulator",
        paper="Haarnoja et al., SAC",
        year=2018,
        needs_data=False,
    ),
    _fast_sac(
        name="fast-sac",
        summary="SAC for cheap simulation",
        paper="Li et al., PQL",
        year=2023,
        needs_data=False,
    ),
    _fast_sac(
        name="rlpd",
        summary="fast-sac, half of each batch logged",
        paper="Ball et al., RLPD",
        year=2023,
        settings={"logged_share": 0.5},
    ),
    _sac(
        name="sac-bc",
        summary="SAC, cloning the data's actions too",
        paper="Jiang et al., Madoc",
        year=2024,
        settings=CLONING,
    ),
    _sac(
        name="dr",
        summary="SAC over the whole box",
        paper="Tobin et al., randomization",
        year=2017,
        settings={"randomize": True},
        needs_data=False,
        needs_parameters=False,
    ),
    _sac(
        name="dr-bc",
        summary="SAC over the whole box, cloning the data",
        paper="Tobin et al., randomization",
        year=2017,
        settings=CLONING | {"randomize": True},
        needs_parameters=False,
    ),
    _offline("bc", BC, "clones the data's policy", "Pomerleau, ALVINN", 1988, shown=("cloning_loss",)),
    _offline(
        "cql",
        CQL,
        "conservative values, from the data alone",
        "Kumar et al., CQL",
        2020,
        shown=("conservative_gap", "value_target", "temperature"),
    ),
    _offline(
        "morec",
        MOREC,
        "a learnt model, kept to what looks real",
        "Luo et al., MOREC",
        2024,
        shown=("model_error", "net_reward", "value_target"),
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

LEARNERS: dict[str, MethodEntry[PolicyLearner[Any]]] = {entry.name: entry for entry in _ENTRIES}
