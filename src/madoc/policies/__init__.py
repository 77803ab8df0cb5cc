"""Policy learners: from a calibrated simulator to a policy. One file a learner; `LEARNERS` finds them by name."""

from madoc.policies.base import NormalParameters as NormalParameters
from madoc.policies.base import PolicyLearner as PolicyLearner
from madoc.policies.base import PolicyProblem as PolicyProblem
from madoc.policies.base import UniformParameters as UniformParameters
from madoc.policies.base import require_reward as require_reward
from madoc.policies.bc import BC as BC
from madoc.policies.cql import CQL as CQL
from madoc.policies.fast_sac import FastSAC as FastSAC
from madoc.policies.h2o import H2O as H2O
from madoc.policies.learn import LEARNERS as LEARNERS
from madoc.policies.learn import LearnedPolicy as LearnedPolicy
from madoc.policies.learn import learn_policy as learn_policy
from madoc.policies.learn import load_policy as load_policy
from madoc.policies.learn import save_policy as save_policy
from madoc.policies.morec import MOREC as MOREC
from madoc.policies.robustness import ErrorCost as ErrorCost
from madoc.policies.robustness import OverDraws as OverDraws
from madoc.policies.robustness import costs_of_errors as costs_of_errors
from madoc.policies.robustness import over_draws as over_draws
from madoc.policies.sac import SAC as SAC
