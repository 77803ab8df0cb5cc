"""Soft actor-critic in simulated systems (arXiv 1812.05905), and SAC+BC: the same with a cloning term."""

from dataclasses import dataclass
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from madoc.errors import MadocError, check_at_least
from madoc.learning import replay, sac_losses
from madoc.learning.networks import descend, moving_average, scan_updates
from madoc.learning.sac_losses import TwinCritic
from madoc.learning.tanh_gaussian import TanhGaussianPolicy, sample
from madoc.policies.base import PolicyProblem
from madoc.simulation.rollout import Rollout, Walkers, begin, reset_states, roll
from madoc.types import Metrics


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Learner:
    """What gradient updates change."""

    policy: TanhGaussianPolicy
    critic: TwinCritic
    target_critic: TwinCritic
    log_temperature: Float[Array, ""]
    policy_optimiser: PyTree
    critic_optimiser: PyTree
    temperature_optimiser: PyTree


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SACState:
    """Everything SAC carries."""

    learner: Learner
    replay: replay.Replay
    walkers: Walkers
    episode_return: Float[np.ndarray, "systems rows"]
    key: PRNGKeyArray
    control_steps: int
    failures: int


@dataclass(frozen=True)
class SAC:
    """Soft actor-critic with twin critics and a learnt temperature, in many environments at a time.

    Attributes:
        hidden: Units per layer of policy and critics.
        environments: Rows acting at a time, spread evenly over the systems.
        epoch_steps: Control steps per `step`.
        updates_per_step: Gradient updates per control step.
        warmup_steps: Control steps with uniform random actions before the first update.
        batch: Rows per update.
        discount: γ.
        target_rate: τ of the target critics.
        learning_rate: Adam's, for policy, critics and temperature.
        replay_capacity: Rows kept.
        cloning: None is SAC. A number w is SAC+BC: the actor minimises w / mean|Q| times SAC's loss plus the
            squared distance to the data's actions. The paper does not print its form; this weighting is
            TD3+BC's (Fujimoto & Gu 2021), with its w = 2.5.
    """

    hidden: tuple[int, ...] = (256, 256)
    environments: int = 20
    epoch_steps: int = 1000
    updates_per_step: float = 1.0
    warmup_steps: int = 5000
    batch: int = 256
    discount: float = 0.99
    target_rate: float = 0.005
    learning_rate: float = 3e-4
    replay_capacity: int = 1_000_000
    cloning: float | None = None

    def __post_init__(self) -> None:
        check_at_least(self, hidden=1, environments=1, batch=1, replay_capacity=1, warmup_steps=0, cloning=0.0)
        check_at_least(self, epoch_steps=self.environments, updates_per_step=0.0, discount=0.0)
        check_at_least(self, target_rate=0.0, learning_rate=0.0)

    @property
    def name(self) -> str:
        """`sac`, or `sac-bc` where it clones."""
        return "sac" if self.cloning is None else "sac-bc"

    @property
    def shown(self) -> tuple[str, ...]:
        """Metrics beside the progress bar."""
        return ("return_in_simulator", "temperature")

    def init(self, problem: PolicyProblem, key: PRNGKeyArray) -> SACState:
        """Fresh networks, an empty replay, rows at reset states.

        Raises:
            MadocError: SAC+BC without a dataset, or fewer environments than systems.
        """
        if self.cloning is not None and problem.dataset is None:
            raise MadocError("sac-bc clones the data's actions: give it a dataset")
        simulator, task = problem.simulator, problem.simulator.task
        systems = len(problem.parameters)
        if self.environments % systems:
            raise MadocError(
                f"expected a multiple of {systems} environments for {systems} systems, got {self.environments}"
            )
        observation, action = task.observation_size, simulator.action_size
        of_policy, of_critic, of_start, key = jax.random.split(key, 4)
        policy = TanhGaussianPolicy(observation, action, self.hidden, key=of_policy)
        critic = TwinCritic(observation + action, self.hidden, key=of_critic)
        log_temperature = jnp.zeros(())
        learner = Learner(
            policy,
            critic,
            jax.tree.map(lambda leaf: leaf.copy() if eqx.is_array(leaf) else leaf, critic),
            log_temperature,
            *(self._optimiser.init(eqx.filter(net, eqx.is_array)) for net in (policy, critic, log_temperature)),
        )
        columns = replay.empty(
            self.replay_capacity,
            observation=(observation,),
            action=(action,),
            reward=(),
            next_observation=(observation,),
            terminated=(),
        )
        walkers = begin(reset_states(simulator), of_start, systems=systems, rows=self.environments // systems)
        return SACState(learner, columns, walkers, np.zeros(walkers.age.shape), key, 0, 0)

    def step(self, problem: PolicyProblem, state: SACState) -> tuple[SACState, Metrics]:
        """Act for `epoch_steps` control steps, then update."""
        of_action, of_restart, of_update, key = jax.random.split(state.key, 4)
        simulator = problem.simulator
        warm = state.control_steps >= self.warmup_steps
        rollout, walkers = roll(
            simulator.bind(problem.parameters),
            simulator.task,
            state.learner.policy if warm else uniform_policy(simulator.action_size),
            state.walkers,
            steps=self.epoch_steps // self.environments,
            starts=reset_states(simulator),
            key=of_action,
            restart_key=of_restart,
        )
        filled = replay.add(state.replay, *_replay_rows(rollout))
        finished, episode_return = _episode_returns(rollout, state.episode_return)
        steps = state.control_steps + rollout.valid.size
        learner: Learner = state.learner
        metrics: dict[str, Array] = {}
        if steps >= self.warmup_steps:
            logged = _logged_pairs(problem) if self.cloning is not None else None
            count = round(self.updates_per_step * rollout.valid.size)
            learner, metrics = self._update(learner, filled, logged, of_update, count)
        failures = state.failures + rollout.failures
        if len(finished):
            metrics = {**metrics, "return_in_simulator": finished.mean()}
        following = SACState(learner, filled, walkers, episode_return, key, steps, failures)
        return following, {name: float(value) for name, value in metrics.items()} | {"failures": failures}

    def policy(self, state: SACState) -> TanhGaussianPolicy:
        """The policy learnt so far; deterministic without a key."""
        return state.learner.policy

    def control_steps(self, state: SACState) -> int:
        """Simulated control steps so far."""
        return state.control_steps

    def stage(self, state: SACState) -> str:
        """Word for the progress bar."""
        return "learning" if state.control_steps >= self.warmup_steps else "exploring"

    def progress(self, state: SACState, budget: int) -> float:
        """Share of the budget spent."""
        return min(1.0, state.control_steps / budget)

    def converged(self, state: SACState) -> str | None:
        """SAC goes on until its budget is spent."""
        return None

    @cached_property
    def _optimiser(self) -> optax.GradientTransformation:
        return optax.adam(self.learning_rate)

    @eqx.filter_jit
    def _update(
        self,
        learner: Learner,
        filled: replay.Replay,
        logged: tuple[Array, Array] | None,
        key: PRNGKeyArray,
        count: int,
    ) -> tuple[Learner, dict[str, Array]]:
        def update(learner: Learner, key: PRNGKeyArray) -> tuple[Learner, dict[str, Array]]:
            of_batch, of_clone, of_critic, of_actor = jax.random.split(key, 4)
            batch = replay.sample(filled, of_batch, self.batch)
            cloned = None
            if logged is not None:
                rows = jax.random.randint(of_clone, (self.batch,), 0, len(logged[0]))
                cloned = (logged[0][rows], logged[1][rows])
            learner, critic_metrics = self._update_critic(learner, batch, of_critic)
            learner, actor_metrics = self._update_actor(learner, batch["observation"], cloned, of_actor)
            return learner, critic_metrics | actor_metrics

        return scan_updates(update, learner, key, count)

    def _update_critic(
        self, learner: Learner, batch: dict[str, Array], key: PRNGKeyArray
    ) -> tuple[Learner, dict[str, Array]]:
        following = batch["next_observation"]
        action, density = sample(*learner.policy.distribution(following), key)
        target = sac_losses.soft_target(
            batch["reward"],
            batch["terminated"],
            jnp.minimum(*learner.target_critic(following, action)),
            density,
            temperature=jnp.exp(learner.log_temperature),
            discount=self.discount,
        )
        loss, gradients = eqx.filter_value_and_grad(sac_losses.critic_loss)(
            learner.critic, batch["observation"], batch["action"], target
        )
        critic, optimiser = descend(self._optimiser, gradients, learner.critic_optimiser, learner.critic)
        target_critic = moving_average(learner.target_critic, critic, self.target_rate)
        learner = eqx.tree_at(
            lambda parts: (parts.critic, parts.target_critic, parts.critic_optimiser),
            learner,
            (critic, target_critic, optimiser),
        )
        return learner, {"critic_loss": loss, "value_target": target.mean()}

    def _update_actor(
        self, learner: Learner, observation: Array, cloned: tuple[Array, Array] | None, key: PRNGKeyArray
    ) -> tuple[Learner, dict[str, Array]]:
        def loss_of(policy: TanhGaussianPolicy) -> tuple[Array, tuple[Array, Array]]:
            temperature = jnp.exp(learner.log_temperature)
            loss, (value, density) = sac_losses.actor_loss(
                policy, learner.critic, observation, temperature=temperature, key=key
            )
            if cloned is None or self.cloning is None:
                return loss, (loss, density)
            weight = self.cloning / jax.lax.stop_gradient(jnp.abs(value).mean())
            return weight * loss + sac_losses.cloning_error(policy, *cloned), (loss, density)

        (_, (loss, density)), gradients = eqx.filter_value_and_grad(loss_of, has_aux=True)(learner.policy)
        policy, policy_optimiser = descend(self._optimiser, gradients, learner.policy_optimiser, learner.policy)
        target_entropy = -float(len(policy.network.layers[-1].weight) // 2)
        slope = jax.grad(sac_losses.temperature_loss)(learner.log_temperature, density, target_entropy)
        log_temperature, temperature_optimiser = descend(
            self._optimiser, slope, learner.temperature_optimiser, learner.log_temperature
        )
        learner = eqx.tree_at(
            lambda parts: (
                parts.policy,
                parts.policy_optimiser,
                parts.log_temperature,
                parts.temperature_optimiser,
            ),
            learner,
            (policy, policy_optimiser, log_temperature, temperature_optimiser),
        )
        return learner, {
            "actor_loss": loss,
            "entropy": -density.mean(),
            "temperature": jnp.exp(log_temperature),
        }


class UniformPolicy(eqx.Module):
    """Uniform random actions in [-1, 1]; 0 without a key."""

    action_size: int = eqx.field(static=True)

    def __call__(self, observation: Array, key: PRNGKeyArray | None = None) -> Array:
        """Actions for a batch of observations."""
        shape = (*observation.shape[:-1], self.action_size)
        return jnp.zeros(shape) if key is None else jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)


def uniform_policy(action_size: int) -> UniformPolicy:
    """The policy SAC explores with before its first update."""
    return UniformPolicy(action_size)


def _replay_rows(rollout: Rollout) -> tuple[dict[str, np.ndarray], np.ndarray]:
    seen = rollout.transitions
    columns = ("observation", "action", "reward", "next_observation", "terminated")
    rows = {name: replay.flatten_rows(getattr(seen, name), 3) for name in columns}
    return rows, rollout.valid.reshape(-1)


def _logged_pairs(problem: PolicyProblem) -> tuple[Array, Array]:
    assert problem.dataset is not None
    logged = problem.dataset.transitions
    return jnp.asarray(logged.observation, jnp.float32), jnp.asarray(logged.action, jnp.float32)


def _episode_returns(rollout: Rollout, running: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns of the episodes that ended in a rollout, and the running sums of those that did not."""
    finished = []
    seen = rollout.transitions
    for reward, ended, valid in zip(seen.reward, seen.terminated | seen.truncated, rollout.valid, strict=True):
        running = running + np.where(valid, reward, 0.0)
        finished.append(running[ended])
        running = np.where(ended | ~valid, 0.0, running)
    return np.concatenate(finished), running
