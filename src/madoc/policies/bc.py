"""Behaviour cloning (Pomerleau 1988): the data's policy, by maximum likelihood."""

from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PRNGKeyArray, PyTree

from madoc.errors import check_at_least
from madoc.learning.cloning import clone
from madoc.learning.networks import adam, scalars
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.policies.base import PolicyProblem, require_data
from madoc.types import Epoch


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BCState:
    """Everything cloning carries."""

    policy: TanhGaussianPolicy
    optimiser: PyTree
    key: PRNGKeyArray


@dataclass(frozen=True)
class BC:
    """Behaviour cloning: maximises the likelihood of the data's actions; acts with the mean.

    Attributes:
        hidden: Units per layer.
        epoch_updates: Gradient updates per `step`.
        batch: Rows per update.
        learning_rate: Adam's.
    """

    hidden: tuple[int, ...] = (256, 256)
    epoch_updates: int = 1000
    batch: int = 256
    learning_rate: float = 3e-4

    def __post_init__(self) -> None:
        check_at_least(self, hidden=1, epoch_updates=1, batch=1, learning_rate=0.0)

    def init(self, problem: PolicyProblem, key: PRNGKeyArray) -> BCState:
        """A fresh policy that standardises observations as the data has them.

        Raises:
            MadocError: No data, or too little.
        """
        dataset = require_data(problem, rows=self.batch, outcomes=False)
        of_policy, key = jax.random.split(key)
        observation = np.asarray(dataset.transitions.observation)
        spread = observation.std(0)
        policy = TanhGaussianPolicy(
            problem.simulator.task.observation_size,
            problem.simulator.action_size,
            self.hidden,
            key=of_policy,
            offset=observation.mean(0),
            scale=np.where(spread > 1e-8, spread, 1.0),
        )
        return BCState(policy, adam(self.learning_rate).init(eqx.filter(policy, eqx.is_array)), key)

    def step(self, problem: PolicyProblem, state: BCState) -> tuple[BCState, Epoch]:
        """`epoch_updates` updates."""
        of_update, key = jax.random.split(state.key)
        policy, optimiser, metrics = clone(
            state.policy,
            state.optimiser,
            (problem.logged["observation"], problem.logged["action"]),
            of_update,
            optimiser=adam(self.learning_rate),
            batch=self.batch,
            count=self.epoch_updates,
        )
        epoch = Epoch(scalars(metrics), updates=self.epoch_updates, stage="cloning")
        return BCState(policy, optimiser, key), epoch

    def policy(self, state: BCState) -> TanhGaussianPolicy:
        """The policy learnt so far; deterministic without a key."""
        return state.policy
