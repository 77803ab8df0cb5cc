"""Behaviour cloning (Pomerleau 1988): the data's policy, by maximum likelihood."""

from dataclasses import dataclass

import jax
from jaxtyping import PRNGKeyArray

from madoc.learning.cloning import Clone, continue_cloning, fresh_clone
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.policies.base import PolicyProblem, require_data
from madoc.types import Count, Epoch, Layers, NotNegative, check_hyperparameters


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BCState:
    """The state of behaviour cloning."""

    clone: Clone
    key: PRNGKeyArray


@dataclass(frozen=True)
class BC:
    """Behaviour cloning: the policy of the largest likelihood of the data's actions, which acts with its mean.

    Attributes:
        hidden: Units per layer.
        epoch_updates: Gradient updates per `step`.
        batch: Rows per update.
        learning_rate: Adam's.
    """

    hidden: Layers = (256, 256)
    epoch_updates: Count = 1000
    batch: Count = 256
    learning_rate: NotNegative = 3e-4

    def __post_init__(self) -> None:
        check_hyperparameters(self)

    def init(self, problem: PolicyProblem, key: PRNGKeyArray) -> BCState:
        """A fresh policy that standardises observations as the data has them.

        Raises:
            MadocError: No data, or too little.
        """
        require_data(problem, rows=self.batch, outcomes=False)
        of_policy, key = jax.random.split(key)
        logged = problem.logged["observation"], problem.logged["action"]
        clone = fresh_clone(logged, self.hidden, learning_rate=self.learning_rate, key=of_policy)
        return BCState(clone, key)

    def step(self, problem: PolicyProblem, state: BCState) -> tuple[BCState, Epoch]:
        """`epoch_updates` updates."""
        of_update, key = jax.random.split(state.key)
        pairs = problem.logged["observation"], problem.logged["action"]
        clone, metrics = continue_cloning(
            state.clone,
            pairs,
            of_update,
            learning_rate=self.learning_rate,
            batch=self.batch,
            updates=self.epoch_updates,
        )
        return BCState(clone, key), Epoch(metrics, updates=self.epoch_updates, stage="cloning")

    def policy(self, state: BCState) -> TanhGaussianPolicy:
        """The latest policy, as there is nothing to judge it in; deterministic without a key."""
        return state.clone.policy
