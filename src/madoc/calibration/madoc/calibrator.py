"""Madoc, assembled: clone the behaviour, group the parameters, then calibrate them group by group.

Jiang et al. 2024, Algorithm 1. Every equation it uses lives in a file of its own beside this one or in `learning`.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.madoc import grouping
from madoc.calibration.madoc.actors import (
    Actors,
    actor_loss,
    divergence,
    draw_parameters,
    initial_actors,
    prior_weight,
)
from madoc.calibration.madoc.grouping import GroupingVAE
from madoc.calibration.madoc.value_decomposition import GroupCritics, Mixing, value_loss
from madoc.learning import replay
from madoc.learning.cloning import clone
from madoc.learning.dynamics_ratio import Discriminators, discriminator_loss, log_dynamics_ratio
from madoc.learning.networks import descend, moving_average, scan_updates
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.simulation.rollout import (
    Rollout,
    Walkers,
    begin,
    chosen_states,
    replay_actions,
    reset_states,
    roll,
)
from madoc.types import Metrics

Grouping = Literal["learned", "one", "each"]
StartMode = Literal["policy", "logged", "replay"]
HORIZON = {"policy": 50, "logged": 10, "replay": 1}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Agents:
    """What calibration updates change."""

    discriminators: Discriminators
    critics: GroupCritics
    actors: Actors
    prior: Actors
    average: Actors
    discriminator_optimiser: PyTree
    critic_optimiser: PyTree
    actor_optimiser: PyTree
    updates: Int[Array, ""]
    log_noise: Float[Array, ""]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MadocState:
    """Everything Madoc carries."""

    policy: TanhGaussianPolicy
    policy_optimiser: PyTree
    vae: GroupingVAE
    vae_optimiser: PyTree
    schemes: Int[np.ndarray, "votes d"]
    labels: Int[np.ndarray, " d"]
    agents: Agents
    replay: replay.Replay
    walkers: Walkers
    key: PRNGKeyArray
    cloned: int
    grouped: int
    calibrated: int
    control_steps: int
    failures: int


@dataclass(frozen=True)
class Madoc:
    """Multi-agent domain calibration. `Madoc.paper()` has the paper's constants; these are leaner and faster.

    Attributes:
        mixing: `dop` (Madoc), `sum` (Madoc-VDN) or `independent` (Madoc-ISAC).
        groups: `learned`, `one` agent for all (Madoc-S), or `each` parameter its own (ungrouped).
        group_count: Learned groups; None takes the task's own number.
        starts: `policy` (free running from resets, the paper's), `logged` (short rollouts from logged states
            under the clone) or `replay` (one step from logged state and action).
        features: `standardised`, or `raw` as the paper's.
        hidden: Units per layer of clone, discriminators and VAE.
        critic_hidden: Units per layer of each group's critic.
        bound: Discriminator logits are this many tanh.
        dropout: In the discriminators.
        cloning_epochs: Epochs of behaviour cloning, before anything is simulated.
        keep_cloning: Go on cloning during calibration, as the paper does.
        grouping_epochs: Epochs of grouping; each spends `epoch_steps` control steps.
        epoch_steps: Control steps an epoch.
        updates: Updates an epoch, in every stage.
        draws: Parameter draws an epoch.
        horizon: Control steps under one draw; None takes 50, 10 or 1 for the three starts.
        batch: Logged rows, and simulated rows, an update.
        learning_rate: Adam's.
        discriminator_learning_rate: Adam's, for the discriminators.
        entropy_weight: α of Eq. (13).
        prior_time: Updates in which λ of Eq. (13) grows by e.
        prior_largest: Where λ stops growing.
        prior_rate: Of the prior's moving average, every `prior_every` updates.
        prior_every: See `prior_rate`.
        replay_capacity: Simulated rows kept.
    """

    mixing: Mixing = "dop"
    groups: Grouping = "learned"
    group_count: int | None = None
    starts: StartMode = "logged"
    features: Literal["standardised", "raw"] = "standardised"
    hidden: tuple[int, ...] = (128, 128)
    critic_hidden: tuple[int, ...] = (64, 64)
    bound: float = 2.0
    dropout: float = 0.0
    cloning_epochs: int = 50
    keep_cloning: bool = False
    grouping_epochs: int = 20
    epoch_steps: int = 1000
    updates: int = 200
    draws: int = 10
    horizon: int | None = None
    batch: int = 256
    learning_rate: float = 3e-4
    discriminator_learning_rate: float = 1e-3
    entropy_weight: float = 0.05
    prior_time: float = 2e5
    prior_largest: float = 10.0
    prior_rate: float = 1e-3
    prior_every: int = 10
    average_rate: float = 1e-3
    replay_capacity: int = 50_000
    noise_rate: float = 3e-3
    reward_size: float = 1.0
    actor_batch: int = 64
    actor_learning_rate: float = 3e-3
    critic_learning_rate: float = 1e-3

    @classmethod
    def paper(cls, **changes) -> "Madoc":
        """The paper's constants (appendix C and the authors' code): 1000 epochs of 1000 steps and updates."""
        constants = {
            "starts": "policy",
            "features": "raw",
            "hidden": (256, 256),
            "dropout": 0.2,
            "cloning_epochs": 100,
            "keep_cloning": True,
            "grouping_epochs": 200,
            "updates": 1000,
            "horizon": 100,
        }
        return cls(**(constants | changes))

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> MadocState:
        """Fresh networks, empty buffers, rows at their starts."""
        task, simulator = problem.simulator.task, problem.simulator
        count, observation, action = len(simulator.parameters), task.observation_size, simulator.action_size
        of_policy, of_vae, of_discriminators, of_critics, of_start, key = jax.random.split(key, 6)
        logged = problem.dataset.transitions
        policy = TanhGaussianPolicy(
            observation,
            action,
            self.hidden,
            key=of_policy,
            offset=logged.observation.mean(0),
            scale=np.maximum(logged.observation.std(0), 1e-3),
        )
        vae = GroupingVAE(count, observation + action, observation, self.hidden, key=of_vae)
        groups = self._group_count(problem)
        rows, systems = self._rows(self.draws), self.draws
        walkers = begin(self._starts(problem), of_start, systems=systems, rows=rows)
        spread = np.arange(walkers.age.size).reshape(walkers.age.shape) * task.max_episode_steps
        walkers = replace(walkers, age=spread // walkers.age.size)
        return MadocState(
            policy=policy,
            policy_optimiser=self._optimiser.init(eqx.filter(policy, eqx.is_array)),
            vae=vae,
            vae_optimiser=self._optimiser.init(eqx.filter(vae, eqx.is_array)),
            schemes=np.zeros((max(1, self.grouping_epochs // 20), count), dtype=np.int64),
            labels=np.zeros(count, dtype=np.int64) if self.groups != "each" else np.arange(count),
            agents=self._init_agents(problem, of_discriminators, of_critics, groups),
            replay=self._empty_replay(problem),
            walkers=walkers,
            key=key,
            cloned=0,
            grouped=0,
            calibrated=0,
            control_steps=0,
            failures=0,
        )

    def step(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Metrics]:
        """One epoch of whichever stage is due."""
        if state.cloned < self.cloning_epochs and self.starts != "replay":
            return self._clone(problem, state)
        if self._will_group and state.grouped < self.grouping_epochs:
            return self._group(problem, state)
        return self._calibrate(problem, state)

    def estimate(self, problem: CalibrationProblem, state: MadocState) -> Estimate:
        """The moving average of the actors' deterministic output."""
        space = problem.simulator.parameters
        average = state.agents.average
        mean, std = np.asarray(average.mean, np.float64), np.exp(np.asarray(average.log_std, np.float64))
        spread = (1.0 - np.tanh(mean) ** 2) * std * (space.high - space.low) / 2.0
        groups = tuple(
            tuple(np.flatnonzero(state.labels == label).tolist()) for label in np.unique(state.labels)
        )
        return Estimate(space.to_physical(np.tanh(mean)), spread, groups)

    def control_steps(self, state: MadocState) -> int:
        """Simulated control steps so far, grouping included."""
        return state.control_steps

    def stage(self, state: MadocState) -> str:
        """Word for the progress bar."""
        if state.cloned < self.cloning_epochs and self.starts != "replay":
            return "cloning"
        return "grouping" if self._will_group and state.grouped < self.grouping_epochs else "calibrating"

    def progress(self, state: MadocState, budget: int) -> float:
        """Share of the control steps and of the cloning done, cloning counted as a tenth."""
        cloned = state.cloned / self.cloning_epochs if self.starts != "replay" and self.cloning_epochs else 1.0
        return min(1.0, 0.1 * cloned + 0.9 * state.control_steps / budget)

    def converged(self, state: MadocState) -> str | None:
        """Never, yet."""
        return None

    @property
    def _will_group(self) -> bool:
        return self.groups == "learned"

    def _group_count(self, problem: CalibrationProblem) -> int:
        count = len(problem.simulator.parameters)
        chosen = {"one": 1, "each": count, "learned": self.group_count or problem.simulator.task.groups}
        return min(count, chosen[self.groups])

    def _rows(self, systems: int) -> int:
        return max(1, self.epoch_steps // (systems * (self.horizon or HORIZON[self.starts])))

    def _starts(self, problem: CalibrationProblem):
        if self.starts == "policy":
            return reset_states(problem.simulator)
        return chosen_states(problem.logged_states)

    def _features(self, problem: CalibrationProblem) -> tuple[Array, Array]:
        return problem.raw_features if self.features == "raw" else problem.standardised_features

    @cached_property
    def _optimiser(self) -> optax.GradientTransformation:
        return optax.adam(self.learning_rate)

    @cached_property
    def _discriminator_optimiser(self) -> optax.GradientTransformation:
        return optax.adam(self.discriminator_learning_rate)

    def _init_agents(
        self, problem: CalibrationProblem, of_discriminators: PRNGKeyArray, of_critics: PRNGKeyArray, groups: int
    ) -> Agents:
        count = len(problem.simulator.parameters)
        discriminators = Discriminators(
            problem.simulator.task.observation_size,
            problem.simulator.action_size,
            self.hidden,
            key=of_discriminators,
            bound=self.bound,
            dropout=self.dropout,
        )
        critics = GroupCritics(groups, count, self.critic_hidden, key=of_critics)
        return Agents(
            discriminators=discriminators,
            critics=critics,
            actors=initial_actors(count),
            prior=initial_actors(count),
            average=initial_actors(count),
            discriminator_optimiser=self._discriminator_optimiser.init(eqx.filter(discriminators, eqx.is_array)),
            critic_optimiser=optax.adam(self.critic_learning_rate).init(eqx.filter(critics, eqx.is_array)),
            actor_optimiser=optax.adam(self.actor_learning_rate).init(initial_actors(count)),
            updates=jnp.zeros((), jnp.int32),
            log_noise=jnp.zeros(()),
        )

    def _empty_replay(self, problem: CalibrationProblem) -> replay.Replay:
        """Rows of both stages: features, the draw they were simulated under, and which parameter was moved."""
        pair, following = (part.shape[1] for part in self._features(problem))
        return replay.empty(
            self.replay_capacity,
            pair=(pair,),
            following=(following,),
            parameters=(len(problem.simulator.parameters),),
            identity=(),
        )

    def _clone(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Metrics]:
        of_batches, key = jax.random.split(state.key)
        policy, optimiser_state, metrics = clone(
            state.policy,
            state.policy_optimiser,
            problem.pairs,
            of_batches,
            optimiser=self._optimiser,
            batch=self.batch,
            count=self.updates,
        )
        following = replace(
            state, policy=policy, policy_optimiser=optimiser_state, key=key, cloned=state.cloned + 1
        )
        return following, {name: float(value) for name, value in metrics.items()}

    def _simulate(
        self, problem: CalibrationProblem, state: MadocState, draws: Float[np.ndarray, "systems d"]
    ) -> tuple[Rollout, Walkers, PRNGKeyArray]:
        """An epoch's rows under the given draws in [-1, 1]; axes (steps, systems, rows)."""
        of_start, of_action, of_restart, key = jax.random.split(state.key, 4)
        simulator, systems = problem.simulator, len(draws)
        system = simulator.bind(simulator.parameters.to_physical(draws))
        rows, starts = self._rows(systems), self._starts(problem)
        if self.starts == "replay":
            rollout = replay_actions(
                system, simulator.task, problem.logged_states, problem.logged_actions, rows=rows, key=of_start
            )
            return rollout, state.walkers, key
        walkers = state.walkers
        if self.starts == "logged" or walkers.age.shape != (systems, rows):
            walkers = begin(starts, of_start, systems=systems, rows=rows)
        rollout, walkers = roll(
            system,
            simulator.task,
            state.policy,
            walkers,
            steps=self.horizon or HORIZON[self.starts],
            starts=starts,
            key=of_action,
            restart_key=of_restart,
        )
        return rollout, walkers, key

    def _remember(
        self,
        problem: CalibrationProblem,
        rows: replay.Replay,
        rollout: Rollout,
        draws: Float[np.ndarray, "systems d"],
        identity: Int[np.ndarray, " systems"],
    ) -> replay.Replay:
        """Add a rollout's valid rows, each with its system's draw and moved parameter."""
        pair, following = problem.scalings[self.features].features(rollout.transitions)
        shape = rollout.valid.shape
        columns = {
            "pair": pair,
            "following": following,
            "parameters": np.broadcast_to(draws[:, None], (*shape, draws.shape[1])),
            "identity": np.broadcast_to(identity[:, None], shape),
        }
        flat = {name: replay.flatten_rows(column, 3) for name, column in columns.items()}
        return replay.add(rows, flat, rollout.valid.reshape(-1))

    def _group(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Metrics]:
        count = len(problem.simulator.parameters)
        of_draws, of_batches, key = jax.random.split(state.key, 3)
        draws = grouping.one_at_a_time(of_draws, count)
        rollout, _, key = self._simulate(problem, replace(state, key=key), draws)
        rows = self._remember(problem, state.replay, rollout, draws, np.arange(count))
        vae, optimiser_state, metrics = grouping.train(
            state.vae,
            state.vae_optimiser,
            rows,
            of_batches,
            optimiser=self._optimiser,
            batch=self.batch,
            count=self.updates,
        )
        grouped = state.grouped + 1
        schemes = state.schemes
        if grouped > self.grouping_epochs - len(schemes):
            scheme = grouping.cluster(vae.embeddings(), self._group_count(problem), seed=grouped)
            schemes = np.concatenate([schemes[1:], scheme[None]])
        done = grouped == self.grouping_epochs
        following = replace(
            state,
            vae=vae,
            vae_optimiser=optimiser_state,
            schemes=schemes,
            labels=grouping.vote(schemes) if done else state.labels,
            replay=replay.clear(rows) if done else rows,
            key=key,
            grouped=grouped,
            control_steps=state.control_steps + rollout.valid.size,
            failures=state.failures + rollout.failures,
        )
        return following, {name: float(value) for name, value in metrics.items()}

    def _calibrate(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Metrics]:
        of_draws, of_updates, key = jax.random.split(state.key, 3)
        draws = np.asarray(draw_parameters(state.agents.actors, of_draws, self.draws)[0], dtype=np.float64)
        rollout, walkers, key = self._simulate(problem, replace(state, key=key), draws)
        rows = self._remember(problem, state.replay, rollout, draws, np.zeros(self.draws))
        members = jnp.asarray(grouping.members(state.labels, self._group_count(problem)))
        agents, metrics = self._update(
            state.agents, rows, self._features(problem), members, of_updates, self.updates
        )
        following = replace(
            state,
            agents=agents,
            replay=rows,
            walkers=walkers,
            key=key,
            calibrated=state.calibrated + 1,
            control_steps=state.control_steps + rollout.valid.size,
            failures=state.failures + rollout.failures,
        )
        if self.keep_cloning and self.starts != "replay":
            following, cloning_metrics = self._clone(problem, following)
            metrics = metrics | cloning_metrics
        return following, {name: float(value) for name, value in metrics.items()}

    @eqx.filter_jit
    def _update(
        self,
        agents: Agents,
        simulated: replay.Replay,
        logged: tuple[Array, Array],
        members: Bool[Array, "groups d"],
        key: PRNGKeyArray,
        count: int,
    ) -> tuple[Agents, dict[str, Array]]:
        def update(agents: Agents, key: PRNGKeyArray) -> tuple[Agents, dict[str, Array]]:
            of_logged, of_simulated, of_dropout, of_actors, of_noise = jax.random.split(key, 5)
            rows = jax.random.randint(of_logged, (self.batch,), 0, len(logged[0]))
            real = (logged[0][rows], logged[1][rows])
            drawn = replay.sample(simulated, of_simulated, self.batch)
            n1, n2 = jax.random.normal(of_noise, (2, *real[1].shape)) * jnp.exp(agents.log_noise)
            real = (real[0], real[1] + n1)
            drawn = drawn | {"following": drawn["following"] + n2}
            agents, metrics = self._update_discriminators(agents, real, drawn, of_dropout)
            reward = log_dynamics_ratio(agents.discriminators, drawn["pair"], drawn["following"])
            size = jnp.abs(reward).mean()
            if self.noise_rate:
                agents = replace(agents, log_noise=jnp.maximum(agents.log_noise + self.noise_rate * jnp.clip(size - self.reward_size,-1,1), -9.0))
            metrics = metrics | {"noise": jnp.exp(agents.log_noise), "size": size}
            agents, value_metrics = self._update_critics(agents, drawn["parameters"], reward, members)
            agents, actor_metrics = self._update_actors(agents, members, of_actors)
            return agents, metrics | value_metrics | actor_metrics

        return scan_updates(update, agents, key, count)

    def _update_discriminators(
        self, agents: Agents, real: tuple[Array, Array], drawn: dict[str, Array], key: PRNGKeyArray
    ) -> tuple[Agents, dict[str, Array]]:
        (_, metrics), gradients = eqx.filter_value_and_grad(discriminator_loss, has_aux=True)(
            agents.discriminators, real, (drawn["pair"], drawn["following"]), key
        )
        discriminators, optimiser = descend(
            self._discriminator_optimiser, gradients, agents.discriminator_optimiser, agents.discriminators
        )
        return replace(agents, discriminators=discriminators, discriminator_optimiser=optimiser), metrics

    def _update_critics(
        self, agents: Agents, parameters: Array, reward: Array, members: Array
    ) -> tuple[Agents, dict[str, Array]]:
        def loss_of(critics: GroupCritics) -> Array:
            values = critics.values(parameters, members)
            return value_loss(values, critics.weight, critics.bias, reward, self.mixing)

        loss, gradients = eqx.filter_value_and_grad(loss_of)(agents.critics)
        critics, optimiser = descend(optax.adam(self.critic_learning_rate), gradients, agents.critic_optimiser, agents.critics)
        at_bound = (jnp.abs(reward) > 0.95 * 2 * self.bound).mean()
        metrics = {"value_loss": loss, "reward": reward.mean(), "reward_at_bound": at_bound}
        return replace(agents, critics=critics, critic_optimiser=optimiser), metrics

    def _update_actors(
        self, agents: Agents, members: Array, key: PRNGKeyArray
    ) -> tuple[Agents, dict[str, Array]]:
        weight = prior_weight(agents.updates, time_constant=self.prior_time, largest=self.prior_largest)

        def loss_of(actors: Actors) -> Array:
            draws, density = draw_parameters(actors, key, self.actor_batch)
            return actor_loss(
                agents.critics.values(draws, members).sum(-1),
                density,
                divergence(actors, agents.prior).sum(),
                entropy_weight=self.entropy_weight,
                prior_weight=weight,
            )

        loss, gradients = jax.value_and_grad(loss_of)(agents.actors)
        actors, optimiser = descend(optax.adam(self.actor_learning_rate), gradients, agents.actor_optimiser, agents.actors)
        due = (agents.updates + 1) % self.prior_every == 0
        prior = moving_average(agents.prior, actors, jnp.where(due, self.prior_rate, 0.0))
        following = replace(
            agents,
            actors=actors,
            prior=prior,
            average=moving_average(agents.average, actors, self.average_rate),
            actor_optimiser=optimiser,
            updates=agents.updates + 1,
        )
        return following, {"actor_loss": loss, "actor_std": jnp.exp(actors.log_std).mean()}
