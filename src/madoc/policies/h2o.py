"""H2O: logged rows and simulated ones together, the simulated ones trusted by their dynamics.

Niu et al. 2022 (arXiv 2206.13464).
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from madoc.learning import replay
from madoc.learning.actor_critic import ActorCritic, Batch, Descent, actor_step, bellman_target, critic_step, fresh
from madoc.learning.dynamics_ratio import Discriminators, discriminator_loss, log_dynamics_ratio
from madoc.learning.features import Features
from madoc.learning.networks import Observations, PerRow, Scalar, adam, descend, scalars, scan_updates
from madoc.learning.sac_losses import TwinCritic
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.policies.base import PolicyProblem, draw_rows, require_data
from madoc.policies.interaction import Interaction, Judged, check_epoch, explore_or_act, judge, start_acting
from madoc.types import Count, CountOrZero, Epoch, Layers, NotNegative, Several, Share, check_hyperparameters

RATIO_RANGE = (1e-5, 1.0)
"""Range to which the dynamics ratio is clipped; the authors'."""
GAP_RANGE = (1e-30, 10.0)
"""Range to which the dynamics gap is clipped. The authors' lower end, 1e-45, is 0 in float32 and has no logarithm."""


def dynamics_ratio(log_ratio: PerRow) -> PerRow:
    """P_real(s'|s, a) / P_simulated(s'|s, a), the weight of a simulated row's Bellman error in Eq. (10), clipped."""
    return jnp.clip(jnp.exp(log_ratio), *RATIO_RANGE)


def dynamics_gap(
    discriminators: Discriminators,
    pair: Float[Array, "rows pair"],
    following: Observations,
    *,
    spread: float,
    samples: int,
    key: PRNGKeyArray,
) -> PerRow:
    """u(s, a) = KL(P_simulated || P_real), Eq. (7): the mean of -log ratio over s' drawn about the simulated one.

    A deterministic simulator has no distribution to draw from: as in the authors' code, normal noise is added to s'.
    The paper's noise is as wide as the data's states; `spread` is its deviation in units of a step's change.
    """
    noise = spread * jax.random.normal(key, (samples, *following.shape))
    drawn = (jnp.broadcast_to(following, noise.shape) + noise).reshape(-1, following.shape[-1])
    repeated = jnp.broadcast_to(pair, (samples, *pair.shape)).reshape(-1, pair.shape[-1])
    log_ratio = log_dynamics_ratio(discriminators, repeated, drawn).reshape(samples, -1)
    return jnp.clip(-log_ratio.mean(0), *GAP_RANGE)


def gap_weighted_value(value: PerRow, gap: PerRow) -> Scalar:
    """Log Σ ω exp Q over simulated rows, ω = u / Σ u: the closed form of Eq. (9), what H2O pushes down."""
    return jax.nn.logsumexp(value + jnp.log(gap) - jnp.log(gap.sum()))


def h2o_loss(
    critic: TwinCritic,
    logged: tuple[Array, Array, PerRow],
    simulated: tuple[Array, Array, PerRow],
    *,
    ratio: PerRow,
    gap: PerRow,
    weight: float,
) -> tuple[Scalar, Scalar]:
    """Eq. (9) and (10), summed over the twin critics; also the regulariser.

    The loss is the Bellman error of logged rows, that of simulated rows weighted by their dynamics `ratio`, and
    `weight` (β) times the regulariser: it lowers the values of simulated rows where the dynamics `gap` is large and
    raises those of logged rows. Squared errors are not halved, as in the authors' code, to which their weight of 0.01
    belongs. Rows are (observation, action, Bellman target).
    """
    bellman, regulariser = jnp.zeros(()), jnp.zeros(())
    for of_logged, of_simulated in zip(critic(*logged[:2]), critic(*simulated[:2]), strict=True):
        bellman += jnp.mean((of_logged - logged[2]) ** 2) + jnp.mean(ratio * (of_simulated - simulated[2]) ** 2)
        regulariser += gap_weighted_value(of_simulated, gap) - of_logged.mean()
    return bellman + weight * regulariser, regulariser


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Learning:
    """The part of the state that gradient updates change."""

    learner: ActorCritic
    discriminators: Discriminators
    discriminator_optimiser: PyTree


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class H2OState:
    """The state of H2O; `judged` counts in control steps."""

    learning: Learning
    interaction: Interaction
    judged: Judged
    key: PRNGKeyArray


@dataclass(frozen=True)
class H2O:
    """Dynamics-aware hybrid offline-and-online learning: SAC on half logged, half simulated rows.

    Two discriminators classify transitions as logged or simulated. Their ratio weighs the Bellman error of simulated
    rows, and values are held down where simulated and real dynamics differ. Unlike the authors', policy and critics see
    standardised observations, and the discriminators (s, a) and s' - s, for which their input noise of 0.1 is a tenth
    of the spread.

    Attributes:
        hidden: Numbers of units of the hidden layers of policy, critics and discriminators.
        environments: Number of episodes simulated at a time, spread evenly over the systems.
        epoch_steps: Control steps per epoch.
        updates_per_step: Gradient updates per control step.
        warmup_steps: Control steps with uniform random actions before the first update.
        batch: Rows per update, logged and simulated in equal numbers.
        weight: β of the regulariser.
        noise: Standard deviation of the noise on the discriminators' inputs while they learn.
        gap_samples: Next states drawn for the dynamics gap of a row.
        gap_spread: Standard deviation of those next states, in units of a step's change.
        bound: Largest absolute value of the logits that s' adds to those of (s, a).
        pair_bound: The same of the logits of (s, a). The authors' is 2, like the other: too narrow where the policy is
            far from the data. The logits of s' then make up for it, and the ratio rejects every simulated row.
        discount: γ.
        target_rate: τ of the target critics.
        learning_rate: Adam's, for everything.
        replay_capacity: Simulated rows kept.
        judge_every: Control steps, those of the warm-up counted, after which the policy acts whole episodes, without
            noise, in the systems it is learnt in; the best so far is handed back, as of SAC. 0 hands back the last.
        judge_episodes: Episodes it is judged by. Their control steps are counted, but not against the budget.
    """

    hidden: Layers = (256, 256)
    environments: Count = 20
    epoch_steps: Count = 1000
    updates_per_step: NotNegative = 1.0
    warmup_steps: CountOrZero = 1000
    batch: Several = 256
    weight: NotNegative = 0.01
    noise: NotNegative = 0.1
    gap_samples: Count = 10
    gap_spread: NotNegative = 1.0
    bound: NotNegative = 2.0
    pair_bound: NotNegative = 10.0
    discount: Share = 0.99
    target_rate: Share = 0.005
    learning_rate: NotNegative = 3e-4
    replay_capacity: Count = 1_000_000
    judge_every: CountOrZero = 10_000
    judge_episodes: Count = 10

    def __post_init__(self) -> None:
        check_hyperparameters(self)
        check_epoch(self.epoch_steps, environments=self.environments, updates_per_step=self.updates_per_step)

    def init(self, problem: PolicyProblem, key: PRNGKeyArray) -> H2OState:
        """Fresh networks, an empty replay, rows at reset states.

        Raises:
            MadocError: No data, too little, data without rewards, or fewer environments than systems.
        """
        require_data(problem, rows=self.batch)
        of_learner, of_discriminators, of_start, key = jax.random.split(key, 4)
        sizes = problem.simulator.task.observation_size, problem.simulator.action_size
        learner = fresh(*sizes, hidden=self.hidden, descent=self._descent, features=problem.features, key=of_learner)
        discriminators = Discriminators(
            *sizes, self.hidden, key=of_discriminators, bound=self.bound, pair_bound=self.pair_bound, dropout=0.0
        )
        optimiser = adam(self.learning_rate).init(eqx.filter(discriminators, eqx.is_array))
        interaction = start_acting(problem, of_start, environments=self.environments, capacity=self.replay_capacity)
        learning = Learning(learner, discriminators, optimiser)
        return H2OState(learning, interaction, Judged.none(learner.policy), key)

    def step(self, problem: PolicyProblem, state: H2OState) -> tuple[H2OState, Epoch]:
        """Act for `epoch_steps` control steps, then update, then judge the policy where that is due."""
        of_acting, of_update, key, of_judging = jax.random.split(state.key, 4)
        interaction, epoch, due = explore_or_act(
            problem,
            state.interaction,
            state.learning.learner.policy,
            of_acting,
            control_steps=self.epoch_steps,
            warmup_steps=self.warmup_steps,
            updates_per_step=self.updates_per_step,
        )
        learning = state.learning
        if interaction.control_steps >= self.warmup_steps:
            learning, losses = self._update(
                learning, interaction.replay, problem.logged, problem.features, of_update, due
            )
            epoch = replace(epoch, metrics=epoch.metrics | scalars(losses))
        judged, spent = state.judged, interaction.control_steps
        if judged.due(spent, self.judge_every) and learning is not state.learning:
            policy = learning.learner.policy
            judged, epoch = judge(problem, policy, judged, epoch, of_judging, episodes=self.judge_episodes, spent=spent)
        return H2OState(learning, interaction, judged, key), epoch

    @eqx.filter_jit
    def _update(
        self, learning: Learning, seen: replay.Replay, logged: Batch, features: Features, key: PRNGKeyArray, count: int
    ) -> tuple[Learning, dict[str, Array]]:
        """`count` updates of discriminators, critics, policy and temperature."""

        def update(learning: Learning, key: PRNGKeyArray) -> tuple[Learning, dict[str, Array]]:
            of_logged, of_simulated, of_noise, of_critics, of_actor = jax.random.split(key, 5)
            real = draw_rows(logged, of_logged, self.batch // 2)
            simulated = replay.sample(seen, of_simulated, self.batch // 2)
            discriminators, optimiser, of_ratio = self._update_discriminators(
                learning, real, simulated, features, of_noise
            )
            learner, of_values = self._value(learning.learner, discriminators, real, simulated, features, of_critics)
            observation = jnp.concatenate([real["observation"], simulated["observation"]])
            learner, of_policy = actor_step(learner, observation, of_actor, self._descent)
            return Learning(learner, discriminators, optimiser), of_ratio | of_values | of_policy

        return scan_updates(update, learning, key, count)

    def _update_discriminators(
        self, learning: Learning, real: Batch, simulated: Batch, features: Features, key: PRNGKeyArray
    ) -> tuple[Discriminators, PyTree, dict[str, Array]]:
        """One step of the discriminators, on noisy inputs."""
        described = [part for rows in (real, simulated) for part in features.described(rows)]
        keys = jax.random.split(key, len(described))
        noisy = [
            part + self.noise * jax.random.normal(part_key, part.shape)
            for part, part_key in zip(described, keys, strict=True)
        ]

        def loss_of(discriminators: Discriminators) -> tuple[Array, dict[str, Array]]:
            return discriminator_loss(discriminators, (noisy[0], noisy[1]), (noisy[2], noisy[3]))

        (_, metrics), gradients = eqx.filter_value_and_grad(loss_of, has_aux=True)(learning.discriminators)
        discriminators, optimiser = descend(
            adam(self.learning_rate), gradients, learning.discriminator_optimiser, learning.discriminators
        )
        return discriminators, optimiser, metrics

    def _value(
        self,
        learner: ActorCritic,
        discriminators: Discriminators,
        real: Batch,
        simulated: Batch,
        features: Features,
        key: PRNGKeyArray,
    ) -> tuple[ActorCritic, dict[str, Array]]:
        """One step of the critics, without entropy in the backup."""
        of_real, of_simulated, of_gap = jax.random.split(key, 3)
        pair, following = features.described(simulated)
        ratio = dynamics_ratio(log_dynamics_ratio(discriminators, pair, following))
        gap = dynamics_gap(
            discriminators, pair, following, spread=self.gap_spread, samples=self.gap_samples, key=of_gap
        )
        targets = [
            bellman_target(learner, rows, rows_key, discount=self.discount, entropy=False)
            for rows, rows_key in ((real, of_real), (simulated, of_simulated))
        ]

        def loss_of(critic: TwinCritic) -> tuple[Array, Array]:
            return h2o_loss(
                critic,
                (real["observation"], real["action"], targets[0]),
                (simulated["observation"], simulated["action"], targets[1]),
                ratio=ratio,
                gap=gap,
                weight=self.weight,
            )

        learner, (loss, regulariser) = critic_step(learner, loss_of, self._descent)
        return learner, {
            "critic_loss": loss,
            "regulariser": regulariser,
            "value_target": targets[0].mean(),
            "dynamics_ratio": ratio.mean(),
            "dynamics_gap": gap.mean(),
        }

    @property
    def _descent(self) -> Descent:
        return Descent.by_adam(policy=self.learning_rate, critic=self.learning_rate, target_rate=self.target_rate)

    def policy(self, state: H2OState) -> TanhGaussianPolicy:
        """The best policy so far, the latest where none was judged; deterministic without a key."""
        return state.judged.handed_back(state.learning.learner.policy)
