"""What methods are told of the sensors, each the same: their noise, and how many rows tell a state."""

from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.learning.features import HIDDEN_WINDOW, last_rows
from madoc.simulation.rollout import Rollout
from madoc.types import NotNegative, named_key

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


def numbers_recalled(problem: CalibrationProblem, rows: int) -> int:
    """How many numbers a clone sees of earlier rows where `rows` are compared: it has to tell the state as they do."""
    return (rows - 1) * (problem.simulator.task.observation_size + problem.simulator.action_size)


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
