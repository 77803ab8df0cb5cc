"""OTED, assembled: a distribution over parameters whose rollouts visit the data's states and actions.

Gur, Nachum and Faust 2021, "Offline tuning of simulators". Only its abstract and appendix D.2 of Jiang et al. 2024
could be had: a distribution over simulator parameters, a divergence between the (s, a) of data and simulator, and a
bandit's policy gradient. Everything else here is our choice, and said so where it is made.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Int, PRNGKeyArray, PyTree

from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.baselines.oted.bandit import (
    Distribution,
    advantages,
    antithetic_noise,
    mean_rewards,
    natural_step,
)
from madoc.calibration.baselines.oted.visits import comparable_starts, first_lives, learn, log_ratio, visits
from madoc.calibration.cautions import at_end_of_range
from madoc.errors import check_at_least
from madoc.learning import replay
from madoc.learning.cloning import clone
from madoc.learning.networks import Network, scalars
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.simulation.rollout import Starts, Walkers, begin, chosen_states, reset_states, roll, unbiased_starts
from madoc.types import Epoch


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OtedState:
    """Everything OTED carries. `average` follows `distribution` slowly; the estimate is read from it."""

    policy: TanhGaussianPolicy
    policy_optimiser: PyTree
    discriminator: Network
    discriminator_optimiser: PyTree
    rows: replay.Replay
    walkers: Walkers
    distribution: Distribution
    average: Distribution
    key: PRNGKeyArray
    cloned: int
    failures: int


@dataclass(frozen=True)
class Oted:
    """Match the (s, a) distribution of a cloned policy's rollouts to that of the data.

    Attributes:
        starts: `logged` rolls out from logged states anew in every epoch; `policy` lets walkers run on from resets.
        draws: Parameter draws an epoch, in antithetic pairs.
        rows: Walkers under each draw.
        horizon: Control steps each walks under it.
        updates: Discriminator updates an epoch.
        batch: Logged rows, and as many simulated ones, in an update.
        mean_rate: Natural-gradient step of the distribution's mean, in its standard deviations.
        std_rate: The same of the logarithm of its deviation.
        first_std: Deviation it begins with, before tanh.
        smallest_std: It stops once the mean deviation has shrunk to this.
        average_rate: Of the slow average that is the estimate.
        hidden: Units per layer of clone and discriminator.
        cloning_epochs: Epochs of behaviour cloning, before anything is simulated.
        cloning_updates: Updates in each.
        learning_rate: Adam's, of both networks.
        replay_capacity: Simulated rows kept for the discriminator.
    """

    starts: Literal["logged", "policy"] = "logged"
    draws: int = 50
    rows: int = 4
    horizon: int = 10
    updates: int = 50
    batch: int = 256
    mean_rate: float = 0.3
    std_rate: float = 0.1
    first_std: float = 0.6
    smallest_std: float = 0.02
    average_rate: float = 0.03
    hidden: tuple[int, ...] = (128, 128)
    cloning_epochs: int = 40
    cloning_updates: int = 200
    learning_rate: float = 1e-3
    replay_capacity: int = 20_000

    def __post_init__(self) -> None:
        counts = ("rows", "updates", "batch", "hidden", "cloning_updates", "replay_capacity")
        check_at_least(self, **dict.fromkeys(counts, 1), draws=2, horizon=2, cloning_epochs=0)
        check_at_least(self, **dict.fromkeys(("mean_rate", "std_rate", "first_std", "average_rate"), 0.0))

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> OtedState:
        """Fresh networks, the distribution around mid-range, walkers at their starts.

        Raises:
            MadocError: Rollouts are to start at logged states, but those cannot be rebuilt, or no episode is as long
                as a rollout.
        """
        task, simulator = problem.simulator.task, problem.simulator
        observation, action, count = task.observation_size, simulator.action_size, len(simulator.parameters)
        of_policy, of_discriminator, of_start, key = jax.random.split(key, 4)
        logged = np.asarray(problem.dataset.transitions.observation)
        policy = TanhGaussianPolicy(
            observation,
            action,
            self.hidden,
            key=of_policy,
            offset=logged.mean(0),
            scale=np.maximum(logged.std(0), 1e-3),
        )
        discriminator = Network(observation + action, 1, self.hidden, key=of_discriminator)
        distribution = Distribution(np.zeros(count), np.full(count, np.log(self.first_std)))
        return OtedState(
            policy=policy,
            policy_optimiser=self._adam.init(eqx.filter(policy, eqx.is_array)),
            discriminator=discriminator,
            discriminator_optimiser=self._adam.init(eqx.filter(discriminator, eqx.is_array)),
            rows=replay.empty(self.replay_capacity, pair=(observation + action,)),
            walkers=begin(self._starts(problem)[0], of_start, systems=self._systems, rows=self.rows),
            distribution=distribution,
            average=distribution,
            key=key,
            cloned=0,
            failures=0,
        )

    def step(self, problem: CalibrationProblem, state: OtedState) -> tuple[OtedState, Epoch]:
        """One epoch of whichever stage is due."""
        return (self._clone if state.cloned < self.cloning_epochs else self._calibrate)(problem, state)

    def estimate(self, problem: CalibrationProblem, state: OtedState) -> Estimate:
        """The averaged distribution through tanh: its centre, and its deviation to first order."""
        space, average = problem.simulator.parameters, state.average
        unit = np.tanh(average.mean)
        std = (1.0 - unit**2) * np.exp(average.log_std) * (space.high - space.low) / 2.0
        return Estimate(
            mean=space.to_physical(unit),
            std=std,
            groups=(tuple(range(len(space))),),
            failures=state.failures,
            warnings=at_end_of_range(unit, space.names),
            covariance=np.diag(std**2),
        )

    @cached_property
    def _adam(self) -> optax.GradientTransformation:
        return optax.adam(self.learning_rate)

    @property
    def _systems(self) -> int:
        return 2 * (self.draws // 2)

    def _starts(self, problem: CalibrationProblem) -> tuple[Starts, Int[np.ndarray, " rows"]]:
        """Where rollouts start, and how often each logged row is visited by the true system from there."""
        if self.starts == "policy":
            return reset_states(problem.simulator), np.ones(len(problem.dataset), dtype=np.int64)
        chosen = comparable_starts(problem.dataset, problem.logged_rows, self.horizon)
        counts = visits(problem.dataset, problem.logged_rows[chosen], self.horizon)
        return chosen_states(problem.logged_states[chosen]), counts

    def _clone(self, problem: CalibrationProblem, state: OtedState) -> tuple[OtedState, Epoch]:
        of_batches, key = jax.random.split(state.key)
        policy, optimiser_state, metrics = clone(
            state.policy,
            state.policy_optimiser,
            problem.pairs,
            of_batches,
            optimiser=self._adam,
            batch=self.batch,
            count=self.cloning_updates,
        )
        following = replace(state, policy=policy, policy_optimiser=optimiser_state, key=key, cloned=state.cloned + 1)
        return following, Epoch(scalars(metrics), stage="cloning", fraction=following.cloned / self.cloning_epochs)

    def _calibrate(self, problem: CalibrationProblem, state: OtedState) -> tuple[OtedState, Epoch]:
        of_draws, of_start, of_action, of_restart, of_updates, key = jax.random.split(state.key, 6)
        simulator, distribution = problem.simulator, state.distribution
        noise = antithetic_noise(of_draws, self._systems // 2, len(distribution.mean))
        draws = np.tanh(distribution.mean + np.exp(distribution.log_std) * noise)
        starts, reached = self._starts(problem)
        fresh = begin(starts, of_start, systems=self._systems, rows=self.rows)
        anew = self.starts == "logged"
        system = simulator.bind(simulator.parameters.to_physical(draws))
        if anew:
            starts, fresh = unbiased_starts(system, starts), replace(fresh, state=system.unbiased(fresh.state))
        rollout, walkers = roll(
            system,
            simulator.task,
            state.policy,
            fresh if anew else state.walkers,
            steps=self.horizon,
            starts=starts,
            key=of_action,
            restart_key=of_restart,
        )
        # The first pair of a row is where it was put: the draw had no part in it.
        pairs = problem.scalings["standardised"].features(rollout.transitions)[0][1:]
        valid = (first_lives(rollout.transitions, rollout.valid) if anew else rollout.valid)[1:]
        rows = replay.add(state.rows, {"pair": replay.flatten_rows(pairs, 3)}, valid.reshape(-1))
        discriminator, optimiser_state, metrics = learn(
            state.discriminator,
            state.discriminator_optimiser,
            problem.standardised_features[0],
            jnp.asarray(np.cumsum(reached), jnp.int32),
            rows,
            of_updates,
            optimiser=self._adam,
            batch=self.batch,
            count=self.updates,
        )
        ratio = np.asarray(log_ratio(discriminator, jnp.asarray(pairs)), np.float64)
        rewards = mean_rewards(ratio, valid)
        moved = natural_step(distribution, noise, advantages(rewards), mean_rate=self.mean_rate, std_rate=self.std_rate)
        following = replace(
            state,
            discriminator=discriminator,
            discriminator_optimiser=optimiser_state,
            rows=rows,
            walkers=state.walkers if anew else walkers,
            distribution=moved,
            average=jax.tree.map(lambda slow, fast: slow + self.average_rate * (fast - slow), state.average, moved),
            key=key,
            failures=state.failures + rollout.failures,
        )
        std = float(np.exp(moved.log_std).mean())
        shrunk = f"the distribution has shrunk to a deviation of {std:.3g} before tanh"
        return following, Epoch(
            scalars(metrics) | {"reward": float(rewards.mean()), "std": std},
            control_steps=rollout.valid.size,
            converged=shrunk if std <= self.smallest_std else None,
        )
