"""OTED, assembled: a distribution over parameters whose rollouts visit the data's states and actions.

Gur, Nachum and Faust 2021, "Offline tuning of simulators". Only its abstract and appendix D.2 of Jiang et al. 2024
could be had: a distribution over simulator parameters, a divergence between the (s, a) of data and simulator, and a
bandit's policy gradient. Everything else is our choice, and marked as such where it is made.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, PRNGKeyArray, PyTree
from pydantic import Field

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
from madoc.learning import replay
from madoc.learning.cloning import Clone, continue_cloning, fresh_clone
from madoc.learning.networks import Network, adam, scalars
from madoc.simulation.rollout import Starts, Walkers, begin, chosen_states, reset_states, roll, unbiased_starts
from madoc.types import Count, CountOrZero, Epoch, Layers, NotNegative, check_hyperparameters


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OtedState:
    """Everything OTED carries. `average` follows `distribution` slowly; the estimate is read from it."""

    clone: Clone
    discriminator: Network
    discriminator_optimiser: PyTree
    rows: replay.Replay
    walkers: Walkers
    distribution: Distribution
    average: Distribution
    key: PRNGKeyArray
    failures: int


@dataclass(frozen=True)
class Oted:
    """Match the (s, a) distribution of a cloned policy's rollouts to that of the data.

    Attributes:
        starts: `logged` rolls out from logged states anew in every epoch; `policy` lets walkers run on from resets.
            None takes `logged` where states are exact, else `policy`.
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

    starts: Literal["logged", "policy"] | None = None
    draws: Annotated[int, Field(ge=2)] = 50
    rows: Count = 4
    horizon: Annotated[int, Field(ge=2)] = 10
    updates: Count = 50
    batch: Count = 256
    mean_rate: NotNegative = 0.3
    std_rate: NotNegative = 0.1
    first_std: NotNegative = 0.6
    smallest_std: float = 0.02
    average_rate: NotNegative = 0.03
    hidden: Layers = (128, 128)
    cloning_epochs: CountOrZero = 40
    cloning_updates: Count = 200
    learning_rate: float = 1e-3
    replay_capacity: Count = 20_000

    def __post_init__(self) -> None:
        check_hyperparameters(self)

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> OtedState:
        """Fresh networks, the distribution around mid-range, walkers at their starts.

        Raises:
            MadocError: Rollouts are to start at logged states, but those cannot be rebuilt, or no episode is as long
                as a rollout.
        """
        task, simulator = problem.simulator.task, problem.simulator
        observation, action, count = task.observation_size, simulator.action_size, len(simulator.parameters)
        of_policy, of_discriminator, of_start, key = jax.random.split(key, 4)
        clone = fresh_clone(problem.dataset.transitions, self.hidden, learning_rate=self.learning_rate, key=of_policy)
        discriminator = Network(observation + action, 1, self.hidden, key=of_discriminator)
        distribution = Distribution(np.zeros(count), np.full(count, np.log(self.first_std)))
        return OtedState(
            clone=clone,
            discriminator=discriminator,
            discriminator_optimiser=adam(self.learning_rate).init(eqx.filter(discriminator, eqx.is_array)),
            rows=replay.empty(self.replay_capacity, pair=(observation + action,)),
            walkers=begin(self._starts(problem)[0], of_start, systems=self._systems, rows=self.rows),
            distribution=distribution,
            average=distribution,
            key=key,
            failures=0,
        )

    def step(self, problem: CalibrationProblem, state: OtedState) -> tuple[OtedState, Epoch]:
        """One epoch of whichever stage is due."""
        return (self._clone if state.clone.epochs < self.cloning_epochs else self._calibrate)(problem, state)

    def estimate(self, problem: CalibrationProblem, state: OtedState) -> Estimate:
        """The averaged distribution through tanh: its centre, and its deviation to first order."""
        space, average = problem.simulator.parameters, state.average
        scaled = np.tanh(average.mean)
        std = (1.0 - scaled**2) * np.exp(average.log_std) * (space.high - space.low) / 2.0
        return Estimate(
            mean=space.to_physical(scaled),
            std=std,
            failures=state.failures,
            warnings=at_end_of_range(scaled, space.names),
            covariance=np.diag(std**2),
        )

    @property
    def _systems(self) -> int:
        return 2 * (self.draws // 2)

    def _starts(self, problem: CalibrationProblem) -> tuple[Starts, Int[np.ndarray, " rows"]]:
        """Where rollouts start, and how often each logged row is visited by the true system from there."""
        if not self._anew(problem):
            return reset_states(problem.simulator), np.ones(len(problem.dataset), dtype=np.int64)
        states, rows = problem.states.exact()
        chosen = comparable_starts(problem.dataset, rows, self.horizon)
        return chosen_states(states[chosen]), visits(problem.dataset, rows[chosen], self.horizon)

    def _anew(self, problem: CalibrationProblem) -> bool:
        """Whether every epoch starts anew at logged states."""
        return (self.starts or ("logged" if problem.states.kind == "exact" else "policy")) == "logged"

    def _clone(self, problem: CalibrationProblem, state: OtedState) -> tuple[OtedState, Epoch]:
        of_batches, key = jax.random.split(state.key)
        clone, metrics = continue_cloning(
            state.clone,
            problem.features.pairs,
            of_batches,
            learning_rate=self.learning_rate,
            batch=self.batch,
            updates=self.cloning_updates,
        )
        epoch = Epoch(metrics, stage="cloning", fraction=clone.epochs / self.cloning_epochs)
        return replace(state, clone=clone, key=key), epoch

    def _calibrate(self, problem: CalibrationProblem, state: OtedState) -> tuple[OtedState, Epoch]:
        of_draws, of_start, of_action, of_restart, of_updates, key = jax.random.split(state.key, 6)
        simulator, distribution = problem.simulator, state.distribution
        noise = antithetic_noise(of_draws, self._systems // 2, len(distribution.mean))
        draws = np.tanh(distribution.mean + np.exp(distribution.log_std) * noise)
        starts, reached = self._starts(problem)
        fresh = begin(starts, of_start, systems=self._systems, rows=self.rows)
        anew = self._anew(problem)
        system = simulator.bind(simulator.parameters.to_physical(draws))
        if anew:
            starts, fresh = unbiased_starts(system, starts), replace(fresh, state=system.unbiased(fresh.state))
        rollout, walkers = roll(
            system,
            simulator.task,
            state.clone.policy,
            fresh if anew else state.walkers,
            steps=self.horizon,
            starts=starts,
            key=of_action,
            restart_key=of_restart,
        )
        # The first pair of a row is where it was put: the draw had no part in it.
        pairs = problem.features.standardised.features(rollout.transitions)[0][1:]
        valid = (first_lives(rollout.transitions, rollout.valid) if anew else rollout.valid)[1:]
        rows = replay.add(state.rows, {"pair": replay.flatten_rows(pairs, 3)}, valid.reshape(-1))
        discriminator, optimiser_state, metrics = learn(
            state.discriminator,
            state.discriminator_optimiser,
            problem.features.windows("standardised", 1)[1][0],
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
