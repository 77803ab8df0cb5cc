"""What methods are told of the sensors' noise, each the same, and simulated observations with it."""

from dataclasses import replace
from typing import Literal

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.simulation.rollout import Rollout
from madoc.types import NotNegative

SensorNoise = NotNegative | Literal["estimated"] | None
"""Noise relative to a step's typical change, or estimated from the log alone, or, with None, as the log declares."""


def noise_deviation(problem: CalibrationProblem, share: SensorNoise) -> Float[np.ndarray, " observation"]:
    """Standard deviation of the noise of observations: that which the data declares, or as told."""
    if share == "estimated":
        return problem.estimated_noise
    share = problem.dataset.disturbance.noise if share is None else float(share)
    # The logged change holds the noise of two readings; the share is that of the change without noise.
    return share / np.sqrt(1.0 + 2.0 * share**2) * problem.typical_change


def with_sensor_noise(rollout: Rollout, deviation: Float[np.ndarray, " observation"], key: PRNGKeyArray) -> Rollout:
    """The rollout with noise on its observations; the end of a step and the start of the next have the same noise.

    The policy acted on observations without noise.
    """
    if not deviation.any():
        return rollout
    seen = rollout.transitions
    steps, *others = np.shape(seen.observation)
    noise = deviation * np.asarray(jax.random.normal(key, (steps + 1, *others)), np.float64)
    noisy = replace(seen, observation=seen.observation + noise[:-1], next_observation=seen.next_observation + noise[1:])
    return replace(rollout, transitions=noisy)
