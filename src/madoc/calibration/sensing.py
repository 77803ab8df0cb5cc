"""What methods are told of the sensors, each the same: their noise, and how many rows tell a state."""

from dataclasses import replace
from typing import Literal

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.learning.expectation import Expectation, noise_of_log
from madoc.learning.features import HIDDEN_WINDOW, WindowScaling, last_rows
from madoc.simulation.rollout import Rollout
from madoc.types import NotNegative, named_key

SensorNoise = NotNegative | Literal["estimated"] | None
"""Noise relative to a step's typical change, or estimated from the log alone, or, with None, as the log declares."""


def rows_compared(problem: CalibrationProblem) -> int:
    """Rows that are compared at a time: one where it tells a state, or no episode has more, else `HIDDEN_WINDOW`.

    A row alone does not tell which actions are pending, nor a velocity that is a difference of positions.
    """
    of_several = problem.dataset.disturbance.velocities == "differences" or problem.simulator.task.pending
    tells = problem.states.kind == "exact" and not of_several
    return 1 if tells or not len(last_rows(problem.dataset, HIDDEN_WINDOW)) else HIDDEN_WINDOW


def noise_deviation(problem: CalibrationProblem, share: SensorNoise) -> Float[np.ndarray, " observation"]:
    """Standard deviation of the noise of observations: that which the data declares, or as told."""
    if share == "estimated":
        return problem.estimated_noise
    share = problem.dataset.disturbance.noise if share is None else float(share)
    if not share:
        return np.zeros(problem.dataset.transitions.observation.shape[-1])
    # The logged change holds the noise of two readings; the share is that of the change without noise.
    return share / np.sqrt(1.0 + 2.0 * share**2) * problem.row_change


def numbers_recalled(problem: CalibrationProblem, rows: int) -> int:
    """How many numbers a clone sees of earlier rows where `rows` are compared: it has to tell the state as they do."""
    return (rows - 1) * (problem.simulator.task.observation_size + problem.simulator.action_size)


def log_noise(
    problem: CalibrationProblem, expectation: Expectation, scaling: WindowScaling
) -> Float[np.ndarray, " observation"]:
    """Standard deviation of the noise of observations, estimated from the log alone; see `noise_of_log`.

    Where one row does not tell the state, the regression's residuals say little of the sensors, and the motion is taken
    to be smooth, as `difference_noise` has it.
    """
    if scaling.length > 1:
        return problem.noise_by_differences
    dataset, rows = problem.dataset, scaling.scaling
    consecutive = np.ones(len(dataset), dtype=bool)
    consecutive[dataset.episode_starts] = False
    channels = len(rows.next_scale)
    by_reading = rows.next_scale / rows.pair_scale[:channels]
    logged = problem.features.windows("standardised", 1)[1]
    return noise_of_log(expectation, logged, consecutive, by_reading) * rows.next_scale


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
