"""Soft actor-critic in simulated systems (arXiv 1812.05905); SAC+BC with a cloning term; DR+BC over the whole box."""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from madoc.learning import replay
from madoc.learning.actor_critic import ActorCritic, Batch, Descent, actor_step, fresh, soft_critic_step
from madoc.learning.networks import scalars, scan_inputs
from madoc.learning.sac_losses import cloned_actor_loss, cloning_error
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.policies.base import PolicyProblem, UniformParameters, draw_rows, require_data
from madoc.policies.interaction import Interaction, Judged, check_epoch, explore_or_act, judge, start_acting
from madoc.types import Count, CountOrZero, Epoch, Layers, NotNegative, Share, check_hyperparameters


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SACState:
    """The state of SAC; `judged` counts in control steps."""

    learner: ActorCritic
    interaction: Interaction
    judged: Judged
    key: PRNGKeyArray


@dataclass(frozen=True)
class SAC:
    """Soft actor-critic with twin critics and a learnt temperature, in many environments at a time.

    Attributes:
        hidden: Numbers of units of the hidden layers of policy and critics.
        environments: Number of episodes simulated at a time, spread evenly over the systems.
        epoch_steps: Control steps per epoch.
        updates_per_step: Gradient updates per control step.
        warmup_steps: Control steps with uniform random actions before the first update.
        batch: Rows per update.
        discount: γ.
        target_rate: τ of the target critics.
        learning_rate: Adam's, for policy, critics and temperature.
        replay_capacity: Rows kept.
        cloning: None is SAC. A number w is SAC+BC: the actor minimises w / mean|Q| times SAC's loss plus the
            squared distance to the data's actions. The paper does not print its form; this weighting is
            TD3+BC's (Fujimoto & Gu 2021), with its w = 2.5; and as there, networks see observations standardised.
        randomize: Draw every environment's parameters anew each epoch, uniformly over the simulator's whole box,
            whatever those of the problem: with `cloning`, the paper's baseline DR+BC.
        judge_every: Control steps, those of the warm-up counted, after which the policy acts whole episodes, without
            noise, in the systems it is learnt in; the best so far is what is handed back, as returns of SAC rise and
            fall from one thousand updates to the next. 0 hands back the last.
        judge_episodes: Episodes it is judged by. Their control steps are counted, but not against the budget.
    """

    hidden: Layers = (256, 256)
    environments: Count = 20
    epoch_steps: Count = 1000
    updates_per_step: NotNegative = 1.0
    warmup_steps: CountOrZero = 5000
    batch: Count = 256
    discount: Share = 0.99
    target_rate: Share = 0.005
    learning_rate: NotNegative = 3e-4
    replay_capacity: Count = 1_000_000
    cloning: NotNegative | None = None
    randomize: bool = False
    judge_every: CountOrZero = 10_000
    judge_episodes: Count = 10

    def __post_init__(self) -> None:
        check_hyperparameters(self)
        check_epoch(self.epoch_steps, environments=self.environments, updates_per_step=self.updates_per_step)

    def init(self, problem: PolicyProblem, key: PRNGKeyArray) -> SACState:
        """Fresh networks, an empty replay, rows at reset states.

        Raises:
            MadocError: Cloning without data or with too little, or fewer environments than systems.
        """
        if self.cloning is not None:
            require_data(problem, rows=self.batch, outcomes=False)
        of_learner, of_start, key = jax.random.split(key, 3)
        sizes = problem.simulator.task.observation_size, problem.simulator.action_size
        features = problem.features if self.cloning is not None else None
        learner = fresh(*sizes, hidden=self.hidden, descent=self._descent, features=features, key=of_learner)
        interaction = start_acting(
            self._place(problem), of_start, environments=self.environments, capacity=self.replay_capacity
        )
        return SACState(learner, interaction, Judged.none(learner.policy), key)

    def step(self, problem: PolicyProblem, state: SACState) -> tuple[SACState, Epoch]:
        """Act for `epoch_steps` control steps, then update, then judge the policy where that is due."""
        of_acting, of_update, of_judging, key = jax.random.split(state.key, 4)
        place = self._place(problem)
        interaction, epoch, due = explore_or_act(
            place,
            state.interaction,
            state.learner.policy,
            of_acting,
            control_steps=self.epoch_steps,
            warmup_steps=self.warmup_steps,
            updates_per_step=self.updates_per_step,
        )
        learner = state.learner
        if interaction.control_steps >= self.warmup_steps:
            logged = problem.logged if self.cloning is not None else None
            learner, losses = self._update(learner, interaction.replay, logged, of_update, due)
            epoch = replace(epoch, metrics=epoch.metrics | scalars(losses))
        judged, spent = state.judged, interaction.control_steps
        if judged.due(spent, self.judge_every) and learner is not state.learner:
            policy = learner.policy
            judged, epoch = judge(place, policy, judged, epoch, of_judging, episodes=self.judge_episodes, spent=spent)
        return SACState(learner, interaction, judged, key), epoch

    @eqx.filter_jit
    def _update(
        self, learner: ActorCritic, seen: replay.Replay, logged: Batch | None, key: PRNGKeyArray, count: int
    ) -> tuple[ActorCritic, dict[str, Array]]:
        """`count` updates of critics, policy and temperature. What is random is drawn beforehand, which is faster."""
        of_rows, of_clones, of_noise = jax.random.split(key, 3)
        indices = replay.draw(seen, of_rows, count, self.batch)
        clones = None if logged is None else draw_rows(logged, of_clones, count, self.batch)
        noise = jax.random.normal(of_noise, (count, 2, self.batch, seen.rows["action"].shape[-1]))

        def update(
            learner: ActorCritic, drawn: tuple[Int[Array, " rows"], Batch | None, Float[Array, "2 rows action"]]
        ) -> tuple[ActorCritic, dict[str, Array]]:
            index, cloned, (of_critic, of_actor) = drawn
            batch = replay.take(seen.rows, index)

            def combine(policy: TanhGaussianPolicy, loss: Array, value: Array) -> Array:
                if cloned is None or self.cloning is None:
                    return loss
                error = cloning_error(policy, cloned["observation"], cloned["action"])
                return cloned_actor_loss(loss, value, error, weight=self.cloning)

            learner, of_critics = soft_critic_step(learner, batch, of_critic, self._descent, discount=self.discount)
            learner, of_policy = actor_step(learner, batch["observation"], of_actor, self._descent, combine)
            return learner, of_critics | of_policy

        return scan_inputs(update, learner, (indices, clones, noise))

    @property
    def _descent(self) -> Descent:
        return Descent.by_adam(policy=self.learning_rate, critic=self.learning_rate, target_rate=self.target_rate)

    def _place(self, problem: PolicyProblem) -> PolicyProblem:
        """Where it acts."""
        if not self.randomize:
            return problem
        return PolicyProblem(problem.simulator, UniformParameters(problem.simulator.parameters))

    def policy(self, state: SACState) -> TanhGaussianPolicy:
        """The best policy so far, the latest where none was judged; deterministic without a key."""
        return state.judged.handed_back(state.learner.policy)
