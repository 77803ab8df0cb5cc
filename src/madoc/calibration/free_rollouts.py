"""Rows of a policy that runs freely from the task's resets, as windows that compare with those of the log.

The simulator is never set to a logged state. Every method that needs no states simulates its rows in this way.
"""

from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.errors import MadocError
from madoc.learning import replay
from madoc.learning.features import HIDDEN_WINDOW, WindowScaling, last_rows, unbroken, windows_ending
from madoc.simulation.rollout import Rollout, Walkers, begin, out_of_step, reset_states, roll
from madoc.types import NotNegative, Policy, named_key

SensorNoise = NotNegative | None
"""Noise of the sensors relative to a step's typical change; None estimates it from the log."""


def rows_compared(problem: CalibrationProblem) -> int:
    """Rows that are compared at a time: one where it tells a state, or no episode has more, else `HIDDEN_WINDOW`.

    A row alone does not tell which actions are pending, nor a velocity that is a difference of positions.
    """
    of_several = problem.dataset.disturbance.velocities == "differences" or problem.simulator.task.pending
    tells = problem.states.kind == "exact" and not of_several
    return 1 if tells or not len(last_rows(problem.dataset, HIDDEN_WINDOW)) else HIDDEN_WINDOW


def noise_deviation(problem: CalibrationProblem, share: SensorNoise, rows: int) -> Float[np.ndarray, " observation"]:
    """Standard deviation of the noise of observations: as told, or estimated from the log by windows of so many rows.

    What the log declares of its noise is not read: a user's log declares nothing.
    """
    if share is None:
        return problem.noise_of_log(rows)
    # The logged change holds the noise of two readings; the share is that of the change without noise.
    return share / np.sqrt(1.0 + 2.0 * share**2) * problem.row_change


def begin_freely(
    problem: CalibrationProblem, length: int, key: PRNGKeyArray, *, systems: int, rows: int, spread: bool = True
) -> Walkers:
    """Rows at the task's resets, for a policy that sees as many rows as a window of `length` has.

    It has to tell the state as the window does. With `spread` the ages of rows are spread evenly up to the time limit,
    so that they do not end together.
    """
    simulator = problem.simulator
    recalled = (length - 1) * (simulator.task.observation_size + simulator.action_size)
    walkers = begin(reset_states(simulator), key, systems=systems, rows=rows, recalled=recalled)
    return out_of_step(walkers, simulator.task.max_episode_steps) if spread else walkers


def roll_freely(
    problem: CalibrationProblem,
    policy: Policy,
    candidates: Float[np.ndarray, "systems d"],
    walkers: Walkers,
    *,
    steps: int,
    noise: Float[np.ndarray, " observation"],
    keys: tuple[PRNGKeyArray, PRNGKeyArray],
) -> tuple[Rollout, Walkers]:
    """Rows with axes (steps, systems, rows), a system for each candidate in [-1, 1], with `noise` on observations.

    The noise is a standard deviation of each channel. The keys are those of the actions and of the restarts.
    """
    simulator, (of_actions, of_restarts) = problem.simulator, keys
    rollout, walkers = roll(
        simulator.bind(simulator.parameters.to_physical(candidates)),
        simulator.task,
        policy,
        walkers,
        steps=steps,
        starts=reset_states(simulator),
        key=of_actions,
        restart_key=of_restarts,
    )
    return with_sensor_noise(rollout, noise, of_actions), walkers


def windows_of(
    rollout: Rollout, scaling: WindowScaling
) -> tuple[
    Float[np.ndarray, "windows systems rows window"],
    Float[np.ndarray, "windows systems rows observation"],
    Bool[np.ndarray, "windows systems rows"],
]:
    """Features of the windows of a rollout and of s' after each, and which windows are whole."""
    seen, length = rollout.transitions, scaling.length
    window, following = scaling.features(windows_ending(seen, np.arange(length - 1, len(seen)), length))
    ended = np.asarray(seen.terminated) | np.asarray(seen.truncated)
    return window, following, unbroken(rollout.valid, ended, length)


def without_starts(length: int) -> slice:
    """The windows that a candidate has had an effect on: all but those which are a row's start alone."""
    return slice(1 if length == 1 else 0, None)


def require_rows(rows: replay.Replay, method: str, length: int) -> replay.Replay:
    """The rows simulated so far.

    Raises:
        MadocError: There are none.
    """
    if not int(rows.written):
        raise MadocError(
            f"{method}: every row simulated so far diverged or ended within {length} steps, so there is nothing "
            "to compare with the log; narrow the ranges of the parameters"
        )
    return rows


def with_sensor_noise(rollout: Rollout, deviation: Float[np.ndarray, " observation"], key: PRNGKeyArray) -> Rollout:
    """The rollout with noise on its observations; the end of a step and the start of the next have the same noise.

    The policy acted on observations without noise. The key may be that of the rollout's actions.
    """
    if not deviation.any():
        return rollout
    seen = rollout.transitions
    steps, *others = np.shape(seen.observation)
    standard = jax.random.normal(named_key(key, "sensor noise"), (steps + 1, *others))
    noise = deviation * np.asarray(standard, np.float64)
    noisy = replace(seen, observation=seen.observation + noise[:-1], next_observation=seen.next_observation + noise[1:])
    return replace(rollout, transitions=noisy)
