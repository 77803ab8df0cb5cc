"""Policy learners: from a calibrated simulator to a policy. One file a learner; `LEARNERS` finds them by name."""

from functools import partial

from madoc.policies.base import PolicyLearner, PolicyProblem, require_reward
from madoc.policies.bc import BC
from madoc.policies.cql import CQL
from madoc.policies.files import load_policy, save_policy
from madoc.policies.h2o import H2O
from madoc.policies.learn import LearnedPolicy, learn_policy
from madoc.policies.morec import MOREC
from madoc.policies.sac import SAC
from madoc.policies.systems import NormalParameters, ParameterDistribution, UniformParameters
from madoc.types import MethodEntry

LEARNERS: dict[str, MethodEntry[PolicyLearner]] = {
    "sac": MethodEntry(SAC, "SAC in the calibrated simulator", "Haarnoja et al., SAC", 2018),
    "sac-bc": MethodEntry(
        partial(SAC, cloning=2.5),
        "SAC, cloning the data's actions too",
        "Jiang et al., Madoc",
        2024,
    ),
    "dr-bc": MethodEntry(
        partial(SAC, cloning=2.5, randomize=True),
        "SAC over the whole box, cloning the data",
        "Tobin et al., randomization",
        2017,
    ),
    "bc": MethodEntry(BC, "clones the data's policy", "Pomerleau, ALVINN", 1988, "updates"),
    "cql": MethodEntry(CQL, "conservative values, from the data alone", "Kumar et al., CQL", 2020, "updates"),
    "morec": MethodEntry(MOREC, "a learnt model, kept to what looks real", "Luo et al., MOREC", 2024, "updates"),
    "h2o": MethodEntry(H2O, "SAC on logged and trusted simulated rows", "Niu et al., H2O", 2022),
}

__all__ = [
    "BC",
    "CQL",
    "H2O",
    "LEARNERS",
    "MOREC",
    "SAC",
    "LearnedPolicy",
    "NormalParameters",
    "ParameterDistribution",
    "PolicyLearner",
    "PolicyProblem",
    "UniformParameters",
    "learn_policy",
    "load_policy",
    "require_reward",
    "save_policy",
]
