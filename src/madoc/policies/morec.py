"""MOREC: SAC in a learnt model, of whose transitions only those that look real are kept (arXiv 2310.05422)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from madoc.errors import MadocError
from madoc.learning import replay
from madoc.learning.actor_critic import ActorCritic, Batch, Descent, actor_step, fresh, soft_critic_step
from madoc.learning.dynamics_ensemble import Ensemble, Fitting, fit, holdout_error
from madoc.learning.dynamics_reward import Opposition, oppose, opposition, remember
from madoc.learning.features import Features
from madoc.learning.networks import adam, falling_adam, moving_average, scalars, scan_updates
from madoc.learning.sac_losses import least_value
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.policies.base import PolicyProblem, draw_rows, require_data
from madoc.policies.imagination import (
    ImaginedRows,
    Models,
    StateValue,
    WithoutNoise,
    imagine,
    imagined_return,
    start_imagining,
    worst_value,
)
from madoc.policies.interaction import Judged
from madoc.types import BelowOne, Count, CountOrZero, Epoch, Layers, NotNegative, Several, Share, check_hyperparameters


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MORECState:
    """The state of MOREC.

    Attributes:
        fitting: The models.
        elites: Indices of the models of the smallest error on held-out rows.
        opposition: Generator and discriminators; the past discriminators make up the dynamics reward.
        replay: Imagined transitions.
        under_way: Imagined rows in progress.
        average: The policy with weights that are averages over its last updates.
        judged: The average of the highest imagined return so far; counts in updates of the policy.
        preparing: Updates of models and discriminators so far; those that early stopping saves count as done.
        updates: Updates of the policy so far.
    """

    fitting: Fitting
    elites: Int[Array, " elites"]
    opposition: Opposition
    learner: ActorCritic
    replay: replay.Replay
    under_way: ImaginedRows
    average: TanhGaussianPolicy
    judged: Judged
    key: PRNGKeyArray
    preparing: int
    updates: int


@dataclass(frozen=True)
class MOREC:
    """Model-based offline learning with reward consistency, on the penalty of MOBILE or of MOPO.

    An ensemble of models is fitted to the data until their errors on held-out rows no longer fall, then discriminators
    are trained against a generator; a policy is then learnt by SAC on rows imagined from logged states. At every
    imagined step each elite model draws candidates, of which one that past discriminators find real is kept; if it is
    not, the row ends. The budget counts updates of the policy; those of models and discriminators come before it.

    The constants are the authors' (github.com/polixir/morec) but those said to be chosen. They
    imagine up to 200 transitions for every update, on a GPU, learn for 3 million updates, and scale each past
    discriminator's logits; here logits count as they are, and policy and critics see standardised observations.

    Attributes:
        hidden: Numbers of units of the hidden layers of policy and critics.
        model_hidden: Units per layer of a dynamics model.
        models: Dynamics models.
        elites: How many of them are sampled from.
        model_updates: Most updates of the models. Unlike the authors', their learning rate falls to 0 over these.
        patience: Updates after which fitting ends if no model's error on held-out rows has fallen by 1 %, as in MOPO's
            code; each model is then as it was at its smallest error. 0 makes all `model_updates`, and keeps the last.
        discriminator_hidden: Units per layer of a discriminator.
        discriminators: Past discriminators that make up the dynamics reward.
        discriminator_every: Updates after which one is kept, at the end of an epoch.
        discriminator_updates: Updates of generator and discriminator, after the models'. Chosen, not the authors'.
        noise: Standard deviation of the noise on the discriminators' inputs, in units of a step's change. Chosen.
        samples: Next states drawn from each elite.
        selection_temperature: Of the draw of one of these next states by dynamics reward; 0 takes the one with the
            highest. The authors took 0.1 for most data sets, of scaled logits; ours differ by more.
        threshold: A rollout ends with a step whose dynamics reward is below, which is worth the worst unless it is a
            fall. The authors leave it out; then no target says what such an action is worth, and the policy comes to
            prefer it. Chosen: their 0.6 is of scaled logits, and with ours ends rollouts on the Hopper too early.
        horizon: Longest imagined rollout, in control steps.
        uncertainty: What lowers imagined rewards: `mobile`, how much the models differ on the value of what follows, or
            `mopo`, the largest of their standard deviations, in units of the state.
        penalty: Its weight. Chosen, as is `mopo`. It is to be chosen by dataset: the authors took 1.5 (`mobile`) or 15
            (`mopo`) for Hopper medium, 0.25 or 0.5 for HalfCheetah medium; here (`mopo`) 2.5 does on the Hopper, 1 on
            HalfCheetah. With too little the imagined return rises while the real one falls.
        real: Share of logged rows in a batch. Chosen: the authors took 0.05 for most data sets, 0.5 for two.
        imagined_per_update: Imagined transitions for each update of the policy.
        imagined_rows: Rows imagined at a time.
        epoch_updates: Gradient updates per epoch.
        holdout_every: Every `holdout_every`-th logged row is held out: the models do not see it, and are stopped and
            chosen by it.
        averaged: Updates over which the weights of the policy are averaged, exponentially; 1 is the policy itself. The
            average is what is judged and handed back, as policies swing from update to update. Chosen.
        judge_every: Updates of the policy after which the average acts whole episodes in the models; that of the
            highest mean return, net of MOPO's penalty (MOBILE's changes with the critics), is handed back. 0 hands back
            the last.
        judge_rows: Number of these episodes. By default they are as many imagined steps as learning takes.
        batch: Rows per update.
        discount: γ, below 1. Chosen; the authors' is 0.99, by which a fall 300 steps on counts for a twentieth.
        target_rate: τ of the target critics.
        model_learning_rate: Adam's, for models (at first), generator and discriminators.
        policy_learning_rate: Adam's, for policy and SAC's temperature; three times the authors', who learn longer.
        critic_learning_rate: Adam's, for the critics.
        replay_capacity: Imagined rows kept.
    """

    hidden: Layers = (256, 256)
    model_hidden: Layers = (200, 200, 200, 200)
    models: Count = 7
    elites: Count = 5
    model_updates: Count = 25_000
    patience: CountOrZero = 4000
    discriminator_hidden: Layers = (128, 128)
    discriminators: Count = 10
    discriminator_every: Count = 400
    discriminator_updates: CountOrZero = 8000
    noise: NotNegative = 0.1
    samples: Count = 2
    selection_temperature: NotNegative = 0.1
    threshold: float = 0.05
    horizon: Count = 100
    uncertainty: Literal["mobile", "mopo"] = "mopo"
    penalty: NotNegative = 1.0
    real: BelowOne = 0.5
    imagined_per_update: Count = 10
    imagined_rows: Count = 200
    epoch_updates: Count = 100
    holdout_every: Several = 100
    batch: Several = 256
    discount: BelowOne = 0.995
    target_rate: Share = 0.005
    model_learning_rate: NotNegative = 1e-3
    policy_learning_rate: NotNegative = 3e-4
    critic_learning_rate: NotNegative = 3e-4
    replay_capacity: Count = 100_000
    averaged: Count = 10_000
    judge_every: CountOrZero = 5000
    judge_rows: Count = 50

    def __post_init__(self) -> None:
        check_hyperparameters(self)
        if self.models < self.elites:
            raise MadocError(f"expected at least as many models as elites, {self.elites}, got {self.models}")
        fewest = self.discriminators * max(self.discriminator_every, self.epoch_updates)
        if self.discriminator_updates and self.discriminator_updates < fewest:
            raise MadocError(
                f"expected at least {fewest} discriminator_updates for {self.discriminators} discriminators, got "
                f"{self.discriminator_updates}; lower discriminators or discriminator_every"
            )

    def init(self, problem: PolicyProblem, key: PRNGKeyArray) -> MORECState:
        """Fresh networks, an empty replay, rows at logged observations.

        Raises:
            MadocError: No data, too little, data without rewards, or observations that do not determine the state.
        """
        task = problem.simulator.task
        require_data(problem, rows=max(self.batch, self.holdout_every))
        if task.state_from_observation is None:
            raise MadocError(
                f"an observation of {task.name} does not determine its state, so morec cannot tell where an imagined "
                "episode ends; give the task a state_from_observation, or use cql"
            )
        keys = jax.random.split(key, 6)
        sizes = observation, action = task.observation_size, problem.simulator.action_size
        ensemble = Ensemble(*sizes, self.model_hidden, models=self.models, key=keys[0])
        learner = fresh(*sizes, hidden=self.hidden, descent=self._descent, features=problem.features, key=keys[2])
        adversary = opposition(
            ensemble.only(jnp.asarray(0)),
            observation + action,
            observation,
            hidden=self.discriminator_hidden,
            members=self.discriminators,
            optimiser=adam(self.model_learning_rate),
            key=keys[1],
        )
        columns = {"observation": (observation,), "action": (action,), "next_observation": (observation,)}
        return MORECState(
            Fitting.of(ensemble, self._fitting),
            jnp.arange(self.elites),
            adversary,
            learner,
            replay.empty(self.replay_capacity, **columns, reward=(), terminated=()),
            start_imagining(problem.logged["observation"], self.imagined_rows, keys[3]),
            learner.policy,
            Judged.none(learner.policy),
            keys[4],
            0,
            0,
        )

    def step(self, problem: PolicyProblem, state: MORECState) -> tuple[MORECState, Epoch]:
        """One epoch: `epoch_updates` updates of the models, of the discriminators, or of the policy."""
        key, following = jax.random.split(state.key)
        stages = {"fitting": self._fit, "opposing": self._oppose, "learning": self._learn}
        stage = self._stage(state)
        state, metrics = stages[stage](problem, replace(state, key=key))
        state = replace(state, key=following)
        if stage == "learning":
            return state, Epoch(scalars(metrics), updates=self.epoch_updates, stage=stage)
        prepared = min(1.0, state.preparing / (self.model_updates + self.discriminator_updates))
        return state, Epoch(scalars(metrics), stage=stage, fraction=prepared)

    def _stage(self, state: MORECState) -> str:
        """The stage of the next epoch."""
        if state.preparing >= self.model_updates + self.discriminator_updates:
            return "learning"
        return "fitting" if state.preparing < self.model_updates else "opposing"

    def _fit(self, problem: PolicyProblem, state: MORECState) -> tuple[MORECState, dict[str, Array]]:
        """Fit the models, and choose the elites; once their errors no longer fall, take each at its smallest."""
        latest, optimiser, errors, metrics = self._update_models(
            state.fitting.models, state.fitting.optimiser, problem.logged, problem.features, state.key
        )
        fitting = state.fitting.after(latest, optimiser, errors, self.epoch_updates)
        preparing = state.preparing + self.epoch_updates
        if self.patience and fitting.stale >= self.patience:
            preparing = max(preparing, self.model_updates)
        if preparing >= self.model_updates and self.patience:
            fitting, errors = fitting.ended(), fitting.smallest
        elites = jnp.argsort(errors)[: self.elites]
        state = replace(state, fitting=fitting, elites=elites, preparing=preparing)
        if self._stage(state) != "fitting":
            generator = fitting.models.only(elites[0])
            state = replace(state, opposition=replace(state.opposition, generator=generator))
        return state, metrics | {"model_error": errors[elites].mean()}

    @eqx.filter_jit
    def _update_models(
        self, ensemble: Ensemble, optimiser: PyTree, logged: Batch, features: Features, key: PRNGKeyArray
    ) -> tuple[Ensemble, PyTree, Float[Array, " models"], dict[str, Array]]:
        """`epoch_updates` updates of the models, and their errors on held-out rows."""
        pair, change = features.described(logged)
        reward = (logged["reward"] - features.reward_offset) / features.reward_scale
        rows = (pair, jnp.concatenate([change, reward[:, None]], axis=-1))
        ensemble, optimiser, metrics = fit(
            ensemble,
            optimiser,
            rows,
            key,
            optimiser=self._fitting,
            batch=self.batch,
            count=self.epoch_updates,
            holdout_every=self.holdout_every,
        )
        held_out = slice(self.holdout_every - 1, None, self.holdout_every)
        return ensemble, optimiser, holdout_error(ensemble, rows[0][held_out], rows[1][held_out]), metrics

    def _oppose(self, problem: PolicyProblem, state: MORECState) -> tuple[MORECState, dict[str, Array]]:
        """Train discriminators and their generator."""
        adversary, metrics = self._update_opposition(state.opposition, problem.logged, problem.features, state.key)
        preparing = state.preparing + self.epoch_updates
        state = replace(state, opposition=adversary, preparing=preparing)
        since = (preparing - self.model_updates) % self.discriminator_every
        if since < self.epoch_updates or self._stage(state) != "opposing":
            state = replace(state, opposition=remember(adversary))
        return state, metrics

    @eqx.filter_jit
    def _update_opposition(
        self, adversary: Opposition, logged: Batch, features: Features, key: PRNGKeyArray
    ) -> tuple[Opposition, dict[str, Array]]:
        return oppose(
            adversary,
            features.described(logged),
            key,
            optimiser=adam(self.model_learning_rate),
            batch=self.batch,
            count=self.epoch_updates,
            noise=self.noise,
        )

    def _learn(self, problem: PolicyProblem, state: MORECState) -> tuple[MORECState, dict[str, Array]]:
        """Imagine, then update the policy, then judge it where that is due."""
        of_imagination, of_updates, of_judging = jax.random.split(state.key, 3)
        steps = -(-self.epoch_updates * self.imagined_per_update // self.imagined_rows)
        value = StateValue(state.learner.policy, state.learner.target_critic)
        under_way, rows, imagined = self._imagining(problem, state)(
            state.learner.policy,
            state.under_way,
            value if self.uncertainty == "mobile" else None,
            penalty=self.penalty,
            horizon=self.horizon,
            steps=steps,
            key=of_imagination,
        )
        if not state.updates and float(imagined["unreal"]) == 1.0:
            raise MadocError(
                f"MOREC: every imagined row looks unreal (dynamics reward below {self.threshold:g}), so there is "
                "nothing to learn from; lower threshold, or give the models more updates"
            )
        seen = replay.add(state.replay, rows, jnp.ones(len(rows["reward"]), bool))
        learner, metrics = self._update_policy(state.learner, seen, problem.logged, of_updates)
        updates, judged = state.updates + self.epoch_updates, state.judged
        rate = min(1.0, self.epoch_updates / min(updates, self.averaged))
        average = moving_average(state.average, learner.policy, rate)
        if judged.due(updates, self.judge_every):
            returns = self._judge(problem, state, average, of_judging)
            judged = judged.including(average, returns, updates)
            metrics |= {"judged_return": jnp.asarray(returns)}
        state = replace(state, learner=learner, replay=seen, under_way=under_way, average=average)
        return replace(state, judged=judged, updates=updates), imagined | metrics

    def _judge(self, problem: PolicyProblem, state: MORECState, policy: TanhGaussianPolicy, key: PRNGKeyArray) -> float:
        """Mean return in the models of the policy without noise; episodes begin where logged ones did."""
        of_starts, of_steps = jax.random.split(key)
        begins = problem.logged["observation"][require_data(problem, rows=0).episode_starts]
        longest = problem.simulator.task.max_episode_steps
        act = partial(
            self._imagining(problem, state),
            WithoutNoise(policy),
            value=None,
            penalty=0.0 if self.uncertainty == "mobile" else self.penalty,
            horizon=longest,
            steps=min(self.horizon, longest),
        )
        return imagined_return(act, start_imagining(begins, self.judge_rows, of_starts), longest, of_steps)

    def _imagining(
        self, problem: PolicyProblem, state: MORECState
    ) -> Callable[..., tuple[ImaginedRows, Batch, dict[str, Array]]]:
        """`imagine`, given the models."""
        task = problem.simulator.task
        assert task.state_from_observation is not None
        starts = require_data(problem, rows=0).episode_starts
        models = Models(
            state.fitting.models,
            state.elites,
            state.opposition.past,
            problem.features,
            logged=problem.logged["observation"],
            terminated=task.terminated,
            state_of=task.state_from_observation,
            samples=self.samples,
            selection_temperature=self.selection_temperature,
            threshold=self.threshold,
            worst=worst_value(np.asarray(problem.logged["reward"]), starts, self.discount),
        )
        return partial(imagine, models)

    @eqx.filter_jit
    def _update_policy(
        self, learner: ActorCritic, seen: replay.Replay, logged: Batch, key: PRNGKeyArray
    ) -> tuple[ActorCritic, dict[str, Array]]:
        """SAC on logged and imagined rows; targets are at least what the least logged reward allows (MOBILE's: 0)."""
        real = round(self.real * self.batch)
        least = least_value(logged["reward"], self.discount)

        def update(learner: ActorCritic, key: PRNGKeyArray) -> tuple[ActorCritic, dict[str, Array]]:
            of_logged, of_imagined, of_critics, of_actor = jax.random.split(key, 4)
            parts = draw_rows(logged, of_logged, real), replay.sample(seen, of_imagined, self.batch - real)
            batch = jax.tree.map(lambda *columns: jnp.concatenate(columns), *parts)
            learner, of_values = soft_critic_step(
                learner, batch, of_critics, self._descent, discount=self.discount, least=least
            )
            learner, of_policy = actor_step(learner, batch["observation"], of_actor, self._descent)
            return learner, of_values | of_policy

        return scan_updates(update, learner, key, self.epoch_updates)

    @property
    def _fitting(self) -> optax.GradientTransformation:
        return falling_adam(self.model_learning_rate, self.model_updates)

    @property
    def _descent(self) -> Descent:
        return Descent.by_adam(
            policy=self.policy_learning_rate, critic=self.critic_learning_rate, target_rate=self.target_rate
        )

    def policy(self, state: MORECState) -> TanhGaussianPolicy:
        """The best average so far, the latest where none was judged; deterministic without a key."""
        return state.judged.handed_back(state.average)
