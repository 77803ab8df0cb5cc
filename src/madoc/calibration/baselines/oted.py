"""OTED: a distribution of parameters under which rollouts visit the states and actions of the data.

Gur, Nachum and Faust 2021, "Offline tuning of simulators". We had its abstract and appendix D.2 of Jiang et al. 2024:
a distribution of simulator parameters, a divergence between the (s, a) of data and simulator, and a bandit's policy
gradient. Everything else is our choice, and marked as such where it is made.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree
from pydantic import Field

from madoc.calibration import free_rollouts
from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.baselines.population_search import independent_estimate
from madoc.calibration.free_rollouts import SensorNoise
from madoc.data import Dataset
from madoc.identification.windows import first_rows
from madoc.learning import replay
from madoc.learning.cloning import Clone, cloning_epoch, fresh_clone
from madoc.learning.dynamics_reward import discriminator_loss
from madoc.learning.features import HIDDEN_WINDOW, last_rows
from madoc.learning.networks import Network, adam, minimise, moving_average
from madoc.simulation.rollout import Rollout, Walkers, begin, chosen_states, roll, unbiased_starts
from madoc.types import (
    Count,
    CountOrZero,
    Epoch,
    Layers,
    NotNegative,
    Positive,
    Share,
    Transitions,
    check_hyperparameters,
)

LOG_STD_RANGE = (-6.0, 0.5)
"""Range of the log standard deviation of a parameter before tanh; steps beyond it are clipped."""
REWARD_BOUND = 10.0
"""Largest absolute log ratio of a pair; larger ones are clipped, as the discriminator is then certain anyway."""


def comparable_starts(dataset: Dataset, rows: Int[np.ndarray, " states"], horizon: int) -> Int[np.ndarray, " starts"]:
    """Positions in `rows` at which a rollout may start: the log goes on for `horizon` steps, or until a fall.

    Raises:
        MadocError: No episode is long enough.
    """
    episode = dataset.episode_of(rows)
    falls = np.asarray(dataset.transitions.terminated)[dataset.episode_ends - 1][episode]
    whole = np.zeros(len(rows), dtype=bool)
    whole[first_rows(dataset, rows, horizon)] = True
    return np.flatnonzero(whole | falls)


def visits(dataset: Dataset, starts: Int[np.ndarray, " starts"], horizon: int) -> Int[np.ndarray, " rows"]:
    """How often each row of the log is visited 1 to `horizon` - 1 steps after one of the starts, in its episode.

    Rows drawn in proportion to these counts are distributed as the true system's visits from the starts. Rows drawn
    uniformly are not: the beginning of an episode is seldom reached from another start.
    """
    before = np.append(0, np.cumsum(np.bincount(starts, minlength=len(dataset))))
    row = np.arange(len(dataset))
    first = dataset.episode_starts[dataset.episode_of(row)]
    return before[row] - before[np.maximum(first, row - horizon + 1)]


def first_lives(seen: Transitions, valid: Bool[np.ndarray, " steps *rows"]) -> Bool[np.ndarray, " steps *rows"]:
    """Valid steps of each row before its first end or failure; later steps began at another start."""
    ended = np.asarray(seen.terminated) | np.asarray(seen.truncated) | ~valid
    earlier = np.concatenate([np.zeros_like(ended[:1]), ended[:-1]])
    return valid & ~np.logical_or.accumulate(earlier, axis=0)


@eqx.filter_jit
def log_ratio(discriminator: Network, pairs: Float[Array, "*rows pair"]) -> Float[Array, "*rows"]:
    """The discriminator's estimate of log p_data(s, a) / p_sim(s, a)."""
    return discriminator(pairs)[..., 0]


@eqx.filter_jit
def learn(
    discriminator: Network,
    optimiser_state: PyTree,
    logged: Float[Array, "rows pair"],
    reached: Int[Array, " rows"],
    rows: replay.Replay,
    key: PRNGKeyArray,
    *,
    optimiser: optax.GradientTransformation,
    batch: int,
    count: int,
) -> tuple[Network, PyTree, Float[Array, ""]]:
    """`count` updates of the discriminator on logged and simulated pairs; also the mean loss.

    Its cross-entropy leads its logit to log p_data(s, a) / p_sim(s, a).
    `reached` is the running sum of the weights with which logged pairs are drawn.
    """

    def loss_of(discriminator: Network, key: PRNGKeyArray) -> Float[Array, ""]:
        of_logged, of_simulated = jax.random.split(key)
        drawn = jax.random.randint(of_logged, (batch,), 0, reached[-1])
        chosen = logged[jnp.searchsorted(reached, drawn, side="right")]
        simulated = replay.sample(rows, of_simulated, batch)["pair"]
        return discriminator_loss(discriminator(chosen)[:, 0], discriminator(simulated)[:, 0])

    return minimise(loss_of, discriminator, optimiser_state, key, optimiser=optimiser, count=count)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Distribution:
    """Independent Gaussians whose tanh are parameters in [-1, 1]."""

    mean: Float[np.ndarray, " d"]
    log_std: Float[np.ndarray, " d"]


def antithetic_noise(key: PRNGKeyArray, pairs: int, count: int) -> Float[np.ndarray, "draws d"]:
    """Standard normal draws, each with its mirror image, so that the even part of the reward cancels."""
    half = np.asarray(jax.random.normal(key, (pairs, count)), np.float64)
    return np.concatenate([half, -half])


def mean_rewards(
    log_ratio: Float[np.ndarray, "steps draws rows"], valid: Bool[np.ndarray, "steps draws rows"]
) -> Float[np.ndarray, " draws"]:
    """Reward of each draw: the mean of log p_data / p_sim over the pairs it visited.

    Its mean over draws is -KL(sim || data), and the part of the gradient that goes through p_sim is 0 on average, so
    that the bandit minimises this divergence. The choice of this KL is ours. A draw whose rows all failed gets the
    lowest reward of all draws.
    """
    count = valid.sum((0, 2))
    total = np.where(valid, np.clip(log_ratio, -REWARD_BOUND, REWARD_BOUND), 0.0).sum((0, 2))
    rewards = total / np.maximum(count, 1)
    lowest = rewards[count > 0].min() if count.any() else -REWARD_BOUND
    return np.where(count, rewards, lowest)


def advantages(rewards: Float[np.ndarray, " draws"]) -> Float[np.ndarray, " draws"]:
    """Standardised rewards, so that the size of a step does not depend on their unit."""
    return (rewards - rewards.mean()) / (rewards.std() + 1e-8)


def natural_step(
    distribution: Distribution,
    noise: Float[np.ndarray, "draws d"],
    advantage: Float[np.ndarray, " draws"],
    *,
    mean_rate: float,
    std_rate: float,
) -> Distribution:
    """The bandit's policy gradient, preconditioned by the Fisher matrix of a Gaussian (Wierstra et al. 2014).

    Score-function gradient of the expected reward: μ by A ε / σ, log σ by A (ε² - 1); the Fisher matrix is 1 / σ² and
    2. So μ moves by σ E[A ε], log σ by ½ E[A (ε² - 1)].
    """
    weight = advantage[:, None] / len(advantage)
    mean = distribution.mean + mean_rate * np.exp(distribution.log_std) * (weight * noise).sum(0)
    log_std = distribution.log_std + 0.5 * std_rate * (weight * (noise**2 - 1.0)).sum(0)
    return Distribution(mean, np.clip(log_std, *LOG_STD_RANGE))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OtedState:
    """Everything OTED carries; the estimate is read from `average`, a moving average of `distribution`."""

    clone: Clone
    discriminator: Network
    discriminator_optimiser: PyTree
    rows: replay.Replay
    walkers: Walkers
    distribution: Distribution
    average: Distribution
    key: PRNGKeyArray
    failures: int = 0


@dataclass(frozen=True)
class Oted:
    """Match the (s, a) distribution of a cloned policy's rollouts to that of the data.

    Where one row tells no state, windows of `HIDDEN_WINDOW` rows take the place of (s, a). Rows that run freely are
    given the sensor noise that is estimated from the log.

    Attributes:
        starts: `logged` starts rollouts anew at logged states in every epoch; with `policy`, rows go on from resets.
            None takes `logged` where states are exact, else `policy`.
        draws: Parameter draws in an epoch, in antithetic pairs.
        rows: Rows under each draw.
        horizon: Control steps of each row under its draw.
        updates: Updates of the discriminator in an epoch.
        batch: Logged rows, and as many simulated rows, in an update.
        mean_rate: Natural-gradient step of the distribution's mean, in its standard deviations.
        std_rate: Natural-gradient step of the logarithm of its standard deviation.
        first_std: Initial standard deviation, before tanh.
        smallest_std: Mean standard deviation, before tanh, at which OTED stops.
        average_rate: Rate of the moving average from which the estimate is read.
        hidden: Units per layer of clone and discriminator.
        cloning_epochs: Epochs of behaviour cloning, before anything is simulated.
        cloning_updates: Updates in each epoch of cloning.
        learning_rate: Adam's learning rate of both networks.
        replay_capacity: Number of simulated rows kept for the discriminator.
        sensor_noise: Noise put on rows that run freely, as a share of a step's typical change; None estimates it from
            the log.
    """

    starts: Literal["logged", "policy"] | None = None
    draws: Annotated[int, Field(ge=2)] = 50
    rows: Count = 4
    horizon: Annotated[int, Field(ge=HIDDEN_WINDOW)] = 10
    updates: Count = 50
    batch: Count = 256
    mean_rate: NotNegative = 0.3
    std_rate: NotNegative = 0.1
    first_std: Positive = 0.6
    smallest_std: Positive = 0.02
    average_rate: Share = 0.03
    hidden: Layers = (128, 128)
    cloning_epochs: CountOrZero = 40
    cloning_updates: Count = 200
    learning_rate: NotNegative = 1e-3
    replay_capacity: Count = 20_000
    sensor_noise: SensorNoise = None

    def __post_init__(self) -> None:
        check_hyperparameters(self)

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> OtedState:
        """Fresh networks, the distribution about mid-range, rows at their starts.

        Raises:
            MadocError: Rollouts are to start at logged states, but those cannot be rebuilt, or no episode is as long
                as a rollout.
        """
        task, simulator = problem.simulator.task, problem.simulator
        observation, action, count = task.observation_size, simulator.action_size, len(simulator.parameters)
        of_policy, of_discriminator, of_start, key = jax.random.split(key, 4)
        pairs = problem.features.pairs(self._window(problem) - 1)
        clone = fresh_clone(pairs, self.hidden, learning_rate=self.learning_rate, key=of_policy)
        pair = self._window(problem) * (observation + action)
        discriminator = Network(pair, 1, self.hidden, key=of_discriminator)
        distribution = Distribution(np.zeros(count), np.full(count, np.log(self.first_std)))
        return OtedState(
            clone=clone,
            discriminator=discriminator,
            discriminator_optimiser=adam(self.learning_rate).init(eqx.filter(discriminator, eqx.is_array)),
            rows=replay.empty(self.replay_capacity, pair=(pair,)),
            walkers=free_rollouts.begin_freely(
                problem, self._window(problem), of_start, systems=self._systems, rows=self.rows, spread=False
            ),
            distribution=distribution,
            average=distribution,
            key=key,
        )

    def step(self, problem: CalibrationProblem, state: OtedState) -> tuple[OtedState, Epoch]:
        """One epoch of cloning, or of calibration once the clone is trained."""
        return (self._clone if state.clone.epochs < self.cloning_epochs else self._calibrate)(problem, state)

    def estimate(self, problem: CalibrationProblem, state: OtedState) -> Estimate:
        """Mean of the averaged distribution through tanh, and its standard deviation to first order."""
        scaled = np.tanh(state.average.mean)
        return independent_estimate(problem, scaled, (1.0 - scaled**2) * np.exp(state.average.log_std), state.failures)

    @property
    def _systems(self) -> int:
        return 2 * (self.draws // 2)

    def _anew(self, problem: CalibrationProblem) -> bool:
        """Whether rollouts start anew at logged states in every epoch."""
        return (self.starts or ("logged" if problem.states.kind == "exact" else "policy")) == "logged"

    def _window(self, problem: CalibrationProblem) -> int:
        """Rows that are compared at a time; single ones where rollouts start at logged states."""
        return 1 if self._anew(problem) else free_rollouts.rows_compared(problem)

    def _clone(self, problem: CalibrationProblem, state: OtedState) -> tuple[OtedState, Epoch]:
        clone, key, epoch = cloning_epoch(
            state.clone,
            problem.features.pairs(self._window(problem) - 1),
            state.key,
            learning_rate=self.learning_rate,
            batch=self.batch,
            updates=self.cloning_updates,
            epochs=self.cloning_epochs,
        )
        return replace(state, clone=clone, key=key), epoch

    def _roll_anew(
        self,
        problem: CalibrationProblem,
        clone: Clone,
        draws: Float[np.ndarray, "systems d"],
        of_start: PRNGKeyArray,
        keys: tuple[PRNGKeyArray, PRNGKeyArray],
    ) -> tuple[Rollout, Int[np.ndarray, " rows"]]:
        """Rows that start at logged states, and how often the true system visits each logged row from there.

        Sensors have no noise: where logged states are exact, neither has the log.
        """
        simulator, (states, rows) = problem.simulator, problem.states.exact()
        chosen = comparable_starts(problem.dataset, rows, self.horizon)
        starts, system = chosen_states(states[chosen]), simulator.bind(simulator.parameters.to_physical(draws))
        walkers = begin(starts, of_start, systems=self._systems, rows=self.rows)
        rollout, _ = roll(
            system,
            simulator.task,
            clone.policy,
            replace(walkers, state=system.unbiased(walkers.state)),
            steps=self.horizon,
            starts=unbiased_starts(system, starts),
            key=keys[0],
            restart_key=keys[1],
        )
        return rollout, visits(problem.dataset, rows[chosen], self.horizon)

    def _calibrate(self, problem: CalibrationProblem, state: OtedState) -> tuple[OtedState, Epoch]:
        of_draws, of_start, of_action, of_restart, of_updates, key = jax.random.split(state.key, 6)
        distribution, length = state.distribution, self._window(problem)
        noise = antithetic_noise(of_draws, self._systems // 2, len(distribution.mean))
        draws = np.tanh(distribution.mean + np.exp(distribution.log_std) * noise)
        walkers, keys = state.walkers, (of_action, of_restart)
        if self._anew(problem):
            rollout, reached = self._roll_anew(problem, state.clone, draws, of_start, keys)
            judged = replace(rollout, valid=first_lives(rollout.transitions, rollout.valid))
        else:
            reached = np.ones(len(last_rows(problem.dataset, length)), np.int64)
            rollout, walkers = free_rollouts.roll_freely(
                problem,
                state.clone.policy,
                draws,
                walkers,
                steps=self.horizon,
                noise=free_rollouts.noise_deviation(problem, self.sensor_noise, length),
                keys=keys,
            )
            judged = rollout
        scaling, (logged, _) = problem.features.windows("standardised", length)
        pairs, _, valid = (
            part[free_rollouts.without_starts(length)] for part in free_rollouts.windows_of(judged, scaling)
        )
        rows = replay.add(state.rows, {"pair": replay.flatten_rows(pairs, 3)}, valid.reshape(-1))
        free_rollouts.require_rows(rows, "oted", length)
        discriminator, optimiser_state, loss = learn(
            state.discriminator,
            state.discriminator_optimiser,
            logged,
            jnp.asarray(np.cumsum(reached), jnp.int32),
            rows,
            of_updates,
            optimiser=adam(self.learning_rate),
            batch=self.batch,
            count=self.updates,
        )
        ratio = np.asarray(log_ratio(discriminator, jnp.asarray(pairs)), np.float64)
        rewards = mean_rewards(ratio, valid)
        moved = natural_step(distribution, noise, advantages(rewards), mean_rate=self.mean_rate, std_rate=self.std_rate)
        std = float(np.exp(moved.log_std).mean())
        shrunk = f"the distribution has shrunk to a deviation of {std:.3g} before tanh"
        state = replace(
            state,
            discriminator=discriminator,
            discriminator_optimiser=optimiser_state,
            rows=rows,
            walkers=walkers,
            distribution=moved,
            average=moving_average(state.average, moved, self.average_rate),
            key=key,
            failures=state.failures + rollout.failures,
        )
        return state, Epoch(
            {"discriminator_loss": float(loss), "reward": float(rewards.mean()), "std": std},
            control_steps=rollout.valid.size,
            converged=shrunk if std <= self.smallest_std else None,
        )
