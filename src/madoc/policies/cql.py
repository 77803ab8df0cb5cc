"""Conservative Q-learning, CQL(H), from logged data alone (Kumar et al. 2020, arXiv 2006.04779)."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from madoc.learning.actor_critic import ActorCritic, Batch, Descent, actor_step, bellman_target, critic_step, fresh
from madoc.learning.cloning import cloning_loss
from madoc.learning.networks import Actions, Observations, PerRow, Scalar, scalars, scan_updates
from madoc.learning.sac_losses import TwinCritic
from madoc.learning.tanh_gaussian import TanhGaussianPolicy, sample
from madoc.policies.base import PolicyProblem, draw_rows, require_data
from madoc.types import Count, CountOrZero, Epoch, Layers, NotNegative, Share, check_hyperparameters


def log_integral(value: Float[Array, "samples rows"], log_density: Float[Array, "samples rows"]) -> PerRow:
    """Log ∫ exp Q(s, a) da per row, from actions of known density (appendix F): log mean exp(Q - log density).

    Any mixture of proposals will do, as each sample alone is an unbiased estimate of the integral. The authors' code
    sums instead of averaging: another constant, the same gradient.
    """
    return jax.nn.logsumexp(value - log_density, axis=0) - jnp.log(float(len(value)))


def proposals(
    policy: TanhGaussianPolicy,
    observation: Observations,
    next_observation: Observations,
    *,
    samples: int,
    key: PRNGKeyArray,
) -> tuple[Float[Array, "proposals rows action"], Float[Array, "proposals rows"]]:
    """`samples` actions each from the uniform distribution, from π(s) and from π(s'), with their log densities."""
    of_uniform, of_here, of_there = jax.random.split(key, 3)

    def drawn(observation: Array, key: PRNGKeyArray) -> tuple[Array, Array]:
        mean, log_std = policy.distribution(observation)
        shape = (samples, *mean.shape)
        return sample(jnp.broadcast_to(mean, shape), jnp.broadcast_to(log_std, shape), key)

    here, there = drawn(observation, of_here), drawn(next_observation, of_there)
    uniform = jax.random.uniform(of_uniform, here[0].shape, minval=-1.0, maxval=1.0)
    flat = jnp.full(here[1].shape, -uniform.shape[-1] * jnp.log(2.0))
    actions = jnp.concatenate([uniform, here[0], there[0]])
    return jax.lax.stop_gradient((actions, jnp.concatenate([flat, here[1], there[1]])))


def conservative_gap(
    critic: TwinCritic,
    observation: Observations,
    action: Actions,
    proposed: tuple[Float[Array, "proposals rows action"], Float[Array, "proposals rows"]],
) -> Scalar:
    """Eq. (4), the term with weight α: mean of log ∫ exp Q(s, a) da - Q(s, a of the data), summed over the twins."""
    actions, log_density = proposed
    repeated = jnp.broadcast_to(observation, (*actions.shape[:2], observation.shape[-1]))
    pairs = zip(critic(repeated, actions), critic(observation, action), strict=True)
    first, second = (jnp.mean(log_integral(value, log_density) - logged) for value, logged in pairs)
    return first + second


def cql_loss(
    critic: TwinCritic,
    observation: Observations,
    action: Actions,
    target: PerRow,
    proposed: tuple[Float[Array, "proposals rows action"], Float[Array, "proposals rows"]],
    *,
    weight: float,
) -> tuple[Scalar, Scalar]:
    """Eq. (4): Bellman error plus `weight` times the gap; also the gap.

    The squared error is not halved as it is in the paper: it is not in the authors' code, to which their weights of 5
    and 10 belong.
    """
    first, second = critic(observation, action)
    bellman = jnp.mean((first - target) ** 2) + jnp.mean((second - target) ** 2)
    gap = conservative_gap(critic, observation, action, proposed)
    return bellman + weight * gap, gap


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
