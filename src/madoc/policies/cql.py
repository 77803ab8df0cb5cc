"""Conservative Q-learning from logged data alone (arXiv 2006.04779)."""

from dataclasses import dataclass

import equinox as eqx
import jax
from jaxtyping import Array, PRNGKeyArray

from madoc.learning.actor_critic import ActorCritic, Batch, Descent, actor_step, bellman_target, critic_step, fresh
from madoc.learning.cloning import cloning_loss
from madoc.learning.cql_losses import cql_loss, proposals
from madoc.learning.networks import scalars, scan_updates
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.policies.base import PolicyProblem, draw_rows, require_data
from madoc.types import Count, CountOrZero, Epoch, Layers, NotNegative, Share, check_hyperparameters


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CQLState:
    """The state of CQL."""

    learner: ActorCritic
    key: PRNGKeyArray
    updates: int


@dataclass(frozen=True)
class CQL:
    """CQL(H): SAC on logged rows, whose critics are held down where the data has no actions.

    Without a Lagrange multiplier and without entropy in the backup, as the authors ran it on D4RL's locomotion. Unlike
    theirs, networks see standardised observations.

    Attributes:
        hidden: Units per layer of the policy.
        critic_hidden: Units per layer of the critics.
        weight: Of the regulariser; the authors' 5 (10 in older runs of theirs).
        samples: Actions drawn from each of three proposals: uniform, π(s), π(s').
        cloning_updates: In the first updates the policy clones instead of climbing values that mean nothing yet. The
            authors' 40 000 are of 3 million updates; these of 300 000, in which the temperature has not fallen yet:
            their entropy term is left out here, it would pull the clone from the data.
        epoch_updates: Gradient updates per epoch. With the default networks one costs about as much as 20 of SAC's.
        batch: Rows per update.
        discount: γ.
        target_rate: τ of the target critics.
        policy_learning_rate: Adam's, for policy and temperature.
        critic_learning_rate: Adam's, for the critics.
    """

    hidden: Layers = (256, 256, 256)
    critic_hidden: Layers = (256, 256, 256)
    weight: NotNegative = 5.0
    samples: Count = 10
    cloning_updates: CountOrZero = 4000
    epoch_updates: Count = 20
    batch: Count = 256
    discount: Share = 0.99
    target_rate: Share = 0.005
    policy_learning_rate: NotNegative = 1e-4
    critic_learning_rate: NotNegative = 3e-4

    def __post_init__(self) -> None:
        check_hyperparameters(self)

    def init(self, problem: PolicyProblem, key: PRNGKeyArray) -> CQLState:
        """Fresh networks.

        Raises:
            MadocError: No data, too little, or data without rewards.
        """
        require_data(problem, rows=self.batch)
        of_learner, key = jax.random.split(key)
        learner = fresh(
            problem.simulator.task.observation_size,
            problem.simulator.action_size,
            hidden=self.hidden,
            critic_hidden=self.critic_hidden,
            descent=self._descent,
            features=problem.features,
            key=of_learner,
        )
        return CQLState(learner, key, 0)

    def step(self, problem: PolicyProblem, state: CQLState) -> tuple[CQLState, Epoch]:
        """`epoch_updates` updates."""
        of_update, key = jax.random.split(state.key)
        clones = state.updates < self.cloning_updates
        learner, metrics = self._update(state.learner, problem.logged, of_update, clones, self.epoch_updates)
        epoch = Epoch(scalars(metrics), updates=self.epoch_updates, stage="cloning" if clones else "learning")
        return CQLState(learner, key, state.updates + epoch.updates), epoch

    @eqx.filter_jit
    def _update(
        self, learner: ActorCritic, logged: Batch, key: PRNGKeyArray, clones: bool, count: int
    ) -> tuple[ActorCritic, dict[str, Array]]:
        """`count` updates of critics, policy and temperature."""

        def update(learner: ActorCritic, key: PRNGKeyArray) -> tuple[ActorCritic, dict[str, Array]]:
            of_batch, of_target, of_proposals, of_actor = jax.random.split(key, 4)
            batch = draw_rows(logged, of_batch, self.batch)
            observation, action = batch["observation"], batch["action"]
            target = bellman_target(learner, batch, of_target, discount=self.discount, entropy=False)
            proposed = proposals(
                learner.policy, observation, batch["next_observation"], samples=self.samples, key=of_proposals
            )

            def combine(policy: TanhGaussianPolicy, loss: Array, value: Array) -> Array:
                return cloning_loss(policy, observation, action) if clones else loss

            learner, (loss, gap) = critic_step(
                learner,
                lambda critic: cql_loss(critic, observation, action, target, proposed, weight=self.weight),
                self._descent,
            )
            learner, of_policy = actor_step(learner, observation, of_actor, self._descent, combine)
            return learner, {"critic_loss": loss, "conservative_gap": gap, "value_target": target.mean()} | of_policy

        return scan_updates(update, learner, key, count)

    @property
    def _descent(self) -> Descent:
        return Descent.by_adam(
            policy=self.policy_learning_rate, critic=self.critic_learning_rate, target_rate=self.target_rate
        )

    def policy(self, state: CQLState) -> TanhGaussianPolicy:
        """The latest policy, as there is nothing to judge it in; deterministic without a key."""
        return state.learner.policy
