"""SAC for a simulator that costs little and two cores: the least wall time to a good policy that we measured.

What differs from `sac`, which is the paper's (arXiv 1812.05905), and where it comes from:

- Many environments and one update every eight control steps, not one: rows are cheap, updates are not. FastTD3
  (Seo et al. 2025, arXiv 2505.22642) and Parallel Q-Learning (Li et al. 2023, arXiv 2307.12983) do so on GPUs.
- Updates run while the environments act, as in Parallel Q-Learning: of two cores neither waits. The policy that acts is
  the one from before the epoch's updates, and updates see the rows from before the epoch, so results do not depend on
  timing.
- The learning rate is three times that of `sac`: of these two, the one with the higher return after as many updates.
- The policy is judged every 2,500 updates, beside them as well: on the Hopper returns differ threefold between one
  judgement and the next, so the best of many is far above the best of few.
- The policy is updated once for every `policy_delay` updates of the critics (TD3, Fujimoto et al. 2018,
  arXiv 1802.09477).
- Networks see observations standardised by the mean and deviation of all that were seen (SimBa, Lee et al. 2024,
  arXiv 2410.09754), so a robot's units do not matter.
- Where there is data, a share of every batch may come from it: with half, the entry `rlpd` (RLPD, Ball et al. 2023,
  arXiv 2302.02948; without its layer norms and its ensemble of critics).
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from madoc.errors import MadocError
from madoc.learning import replay
from madoc.learning.actor_critic import ActorCritic, Batch, Descent, actor_step, fresh, soft_critic_step, standardising
from madoc.learning.networks import scalars, scan_inputs
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.policies.base import PolicyProblem, draw_rows, require_data
from madoc.policies.interaction import Interaction, Judged, UniformPolicy, judge, remember, roll_on, start_acting
from madoc.types import Count, CountOrZero, Epoch, Layers, NotNegative, Several, Share, check_hyperparameters

SMALLEST_DEVIATION = 1e-2
"""Added to the standard deviation of each observation value: a value that hardly moved yet may move far later."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FastSACState:
    """The state of FastSAC; `judged` and `updates` count updates of the critics."""

    learner: ActorCritic
    interaction: Interaction
    updates: int
    judged: Judged
    key: PRNGKeyArray


@dataclass(frozen=True)
class FastSAC:
    """Soft actor-critic for cheap simulation: many environments, few updates per control step, none of them waiting.

    Attributes:
        hidden: Units per layer of policy and critics.
        environments: Rows acting at a time, spread evenly over the systems.
        epoch_steps: Control steps per `step`.
        steps_per_update: Control steps per update of the critics.
        policy_delay: Updates of the critics per update of the policy and the temperature.
        warmup_steps: Control steps with uniform random actions before the first update.
        batch: Rows per update.
        discount: Discount factor per control step.
        target_rate: Share of the critics that the target critics take over in an update.
        learning_rate: Adam's, for policy, critics and temperature.
        replay_capacity: Simulated rows kept.
        standardise: Whether networks see observations standardised.
        logged_share: Share of each batch that comes from the logged data; 0 needs no data.
        judge_every: Updates after which the policy acts whole episodes without noise in the systems it is learnt in;
            the best so far is handed back. 0 hands back the last.
        judge_episodes: Episodes it is judged by. Their control steps are counted, but not against the budget.
    """

    hidden: Layers = (128, 128)
    environments: Count = 64
    epoch_steps: Count = 2048
    steps_per_update: Count = 8
    policy_delay: Count = 2
    warmup_steps: Count = 10_000
    batch: Several = 256
    discount: Share = 0.99
    target_rate: Share = 0.005
    learning_rate: NotNegative = 1e-3
    replay_capacity: Count = 1_000_000
    standardise: bool = True
    logged_share: Share = 0.0
    judge_every: CountOrZero = 2_500
    judge_episodes: Count = 10

    def __post_init__(self) -> None:
        check_hyperparameters(self)
        least = max(self.environments, self.steps_per_update * self.policy_delay)
        if self.epoch_steps < least:
            raise MadocError(
                f"expected epoch_steps of at least {least}, for a control step of each environment and an update of "
                f"the policy, got {self.epoch_steps}"
            )

    def init(self, problem: PolicyProblem, key: PRNGKeyArray) -> FastSACState:
        """Fresh networks, an empty replay, rows at reset states.

        Raises:
            MadocError: A share of the batches is to come from data and there is none, or too little, or data without
                rewards; or there are fewer environments than systems.
        """
        if self.logged_share:
            require_data(problem, rows=self.batch)
        of_learner, of_start, key = jax.random.split(key, 3)
        size = problem.simulator.task.observation_size
        learner = fresh(size, problem.simulator.action_size, hidden=self.hidden, descent=self._descent, key=of_learner)
        interaction = start_acting(problem, of_start, environments=self.environments, capacity=self.replay_capacity)
        return FastSACState(learner, interaction, 0, Judged.none(learner.policy), key)

    def step(self, problem: PolicyProblem, state: FastSACState) -> tuple[FastSACState, Epoch]:
        """Update on the rows seen so far; meanwhile act for `epoch_steps`, and judge the policy where that is due."""
        of_acting, of_update, of_judging, key = jax.random.split(state.key, 4)
        explores = state.interaction.control_steps < self.warmup_steps
        policy, judged = state.learner.policy, state.judged
        epoch = Epoch(stage="exploring" if explores else "learning")
        with ThreadPoolExecutor(1) as second_thread:
            updating = None if explores else second_thread.submit(self._update, problem, state, of_update)
            acting = UniformPolicy(problem.simulator.action_size) if explores else policy
            rolled = roll_on(problem, state.interaction, acting, of_acting, control_steps=self.epoch_steps)
            if judged.due(state.updates, self.judge_every):
                spent, episodes = state.updates, self.judge_episodes
                judged, epoch = judge(problem, policy, judged, epoch, of_judging, episodes=episodes, spent=spent)
        learner, losses = (state.learner, {}) if updating is None else updating.result()
        interaction, metrics = remember(state.interaction, *rolled)
        if self.standardise:
            observed = interaction.observed
            scale = observed.deviation + SMALLEST_DEVIATION
            learner = standardising(learner, *(jnp.asarray(part, jnp.float32) for part in (observed.mean, scale)))
        updates = 0 if explores else self._cycles * self.policy_delay
        acted = interaction.control_steps - state.interaction.control_steps
        following = FastSACState(learner, interaction, state.updates + updates, judged, key)
        return following, replace(
            epoch,
            metrics=metrics | epoch.metrics | losses,
            control_steps=acted + epoch.control_steps,
            updates=updates,
        )

    def _update(
        self, problem: PolicyProblem, state: FastSACState, key: PRNGKeyArray
    ) -> tuple[ActorCritic, dict[str, float]]:
        """An epoch's updates, once they are computed."""
        logged = problem.logged if self.logged_share else None
        learner, losses = self._descend(state.learner, state.interaction.replay, logged, key)
        return learner, scalars(losses)

    @eqx.filter_jit
    def _descend(
        self, learner: ActorCritic, seen: replay.Replay, logged: Batch | None, key: PRNGKeyArray
    ) -> tuple[ActorCritic, dict[str, Array]]:
        """An epoch's updates. All rows and all noise are drawn beforehand: drawn within the scan they cost a third."""
        of_rows, of_logged, of_noise = jax.random.split(key, 3)
        shape = self._cycles, self.policy_delay
        from_log = 0 if logged is None else round(self.logged_share * self.batch)
        batches: Batch = replay.sample(seen, of_rows, *shape, self.batch - from_log)
        if logged is not None and from_log:
            rows = draw_rows(logged, of_logged, *shape, from_log)
            batches = {name: jnp.concatenate([batches[name], rows[name]], axis=2) for name in batches}
        noise = jax.random.normal(of_noise, (self._cycles, self.policy_delay + 1, *batches["action"].shape[2:]))

        def cycle(
            learner: ActorCritic, given: tuple[Batch, Float[Array, "steps rows action"]]
        ) -> tuple[ActorCritic, dict[str, Array]]:
            batches, noise = given
            for index in range(self.policy_delay):
                batch = {name: column[index] for name, column in batches.items()}
                learner, of_critics = soft_critic_step(
                    learner, batch, noise[index], self._descent, discount=self.discount
                )
            learner, of_policy = actor_step(learner, batch["observation"], noise[-1], self._descent)
            return learner, of_critics | of_policy

        return scan_inputs(cycle, learner, (batches, noise))

    @property
    def _cycles(self) -> int:
        """Updates of the policy per epoch."""
        return self.epoch_steps // (self.steps_per_update * self.policy_delay)

    @property
    def _descent(self) -> Descent:
        return Descent.by_adam(policy=self.learning_rate, critic=self.learning_rate, target_rate=self.target_rate)

    def policy(self, state: FastSACState) -> TanhGaussianPolicy:
        """The best policy so far, the latest where none was judged; deterministic without a key."""
        return state.judged.handed_back(state.learner.policy)
