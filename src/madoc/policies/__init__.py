"""Policy learners: from a calibrated simulator to a policy. One file a learner; `LEARNERS` finds them by name."""

from madoc.policies.base import PolicyLearner, PolicyProblem, require_reward
from madoc.policies.bc import BC
from madoc.policies.cql import CQL
from madoc.policies.fast_sac import FastSAC
from madoc.policies.files import load_policy, save_policy
from madoc.policies.h2o import H2O
from madoc.policies.learn import LearnedPolicy, learn_policy
from madoc.policies.morec import MOREC
from madoc.policies.registry import LEARNERS
from madoc.policies.sac import SAC
from madoc.policies.systems import NormalParameters, ParameterDistribution, UniformParameters

__all__ = [
    "BC",
    "CQL",
    "H2O",
    "LEARNERS",
    "MOREC",
    "SAC",
    "FastSAC",
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
