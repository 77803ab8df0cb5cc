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
from jaxtyping import Int, PRNGKeyArray, PyTree
from pydantic import Field

from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.baselines.oted.visits import (
    Distribution,
    advantages,
    antithetic_noise,
    comparable_starts,
    first_lives,
    learn,
    log_ratio,
    mean_rewards,
    natural_step,
    visits,
)
from madoc.calibration.baselines.population_search import independent_estimate
from madoc.calibration.sensing import SensorNoise, noise_deviation, numbers_recalled, rows_compared, with_sensor_noise
from madoc.errors import MadocError
from madoc.learning import replay
from madoc.learning.cloning import Clone, cloning_epoch, fresh_clone
from madoc.learning.features import HIDDEN_WINDOW, last_rows, unbroken, windows_ending
from madoc.learning.networks import Network, adam, moving_average
from madoc.simulation.rollout import Starts, Walkers, begin, chosen_states, reset_states, roll, unbiased_starts
from madoc.types import Count, CountOrZero, Epoch, Layers, NotNegative, Positive, Share, check_hyperparameters


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
    failures: int


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
            walkers=self._begin(problem, self._starts(problem)[0], of_start),
            distribution=distribution,
            average=distribution,
            key=key,
            failures=0,
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

    def _starts(self, problem: CalibrationProblem) -> tuple[Starts, Int[np.ndarray, " rows"]]:
        """Where rollouts start, and how often the true system visits each logged window from there."""
        if not self._anew(problem):
            windows = last_rows(problem.dataset, self._window(problem))
            return reset_states(problem.simulator), np.ones(len(windows), dtype=np.int64)
        states, rows = problem.states.exact()
        chosen = comparable_starts(problem.dataset, rows, self.horizon)
        return chosen_states(states[chosen]), visits(problem.dataset, rows[chosen], self.horizon)

    def _anew(self, problem: CalibrationProblem) -> bool:
        """Whether rollouts start anew at logged states in every epoch."""
        return (self.starts or ("logged" if problem.states.kind == "exact" else "policy")) == "logged"

    def _window(self, problem: CalibrationProblem) -> int:
        """Rows that are compared at a time; single ones where rollouts start at logged states."""
        return 1 if self._anew(problem) else rows_compared(problem)

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

    def _begin(self, problem: CalibrationProblem, starts: Starts, key: PRNGKeyArray) -> Walkers:
        recalled = numbers_recalled(problem, self._window(problem))
        return begin(starts, key, systems=self._systems, rows=self.rows, recalled=recalled)

    def _calibrate(self, problem: CalibrationProblem, state: OtedState) -> tuple[OtedState, Epoch]:
        of_draws, of_start, of_action, of_restart, of_updates, key = jax.random.split(state.key, 6)
        simulator, distribution, anew = problem.simulator, state.distribution, self._anew(problem)
        noise = antithetic_noise(of_draws, self._systems // 2, len(distribution.mean))
        draws = np.tanh(distribution.mean + np.exp(distribution.log_std) * noise)
        system = simulator.bind(simulator.parameters.to_physical(draws))
        starts, reached = self._starts(problem)
        walkers = state.walkers
        if anew:
            fresh = self._begin(problem, starts, of_start)
            starts, walkers = unbiased_starts(system, starts), replace(fresh, state=system.unbiased(fresh.state))
        rollout, following = roll(
            system,
            simulator.task,
            state.clone.policy,
            walkers,
            steps=self.horizon,
            starts=starts,
            key=of_action,
            restart_key=of_restart,
        )
        if not anew:
            rollout = with_sensor_noise(
                rollout, noise_deviation(problem, self.sensor_noise, self._window(problem)), of_action
            )
        length, seen = self._window(problem), rollout.transitions
        scaling, (logged, _) = problem.features.windows("standardised", length)
        # The first pair of a row is its start, which does not depend on the draw.
        pairs = scaling.features(windows_ending(seen, np.arange(max(1, length - 1), len(seen)), length))[0]
        lives = first_lives(seen, rollout.valid) if anew else rollout.valid
        valid = unbroken(lives, np.asarray(seen.terminated) | np.asarray(seen.truncated), length)[-len(pairs) :]
        rows = replay.add(state.rows, {"pair": replay.flatten_rows(pairs, 3)}, valid.reshape(-1))
        if not int(rows.written):
            raise MadocError(
                f"oted: every row simulated so far diverged or ended within {length} steps, so there is nothing "
                "to compare with the log; narrow the ranges of the parameters"
            )
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
            walkers=state.walkers if anew else following,
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
