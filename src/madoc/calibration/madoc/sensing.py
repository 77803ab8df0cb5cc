"""How Madoc adapts to partial and noisy observations: longer windows, and noise on simulated observations."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from madoc.calibration.base import CalibrationProblem

HIDDEN_WINDOW = 3
"""Window length, in rows, where velocities are hidden: two rows give a velocity, a third an acceleration."""


def window_length(problem: CalibrationProblem, asked: int | None, starts: str) -> int:
    """Window length in rows: the one asked for, else 1 where observations determine states or rows are replayed."""
    seen = problem.states.kind == "exact"
    return asked or (1 if seen or starts == "replay" else HIDDEN_WINDOW)


def noise_deviation(
    problem: CalibrationProblem, asked: float | Literal["estimated"] | None
) -> Float[np.ndarray, " observation"]:
    """Standard deviation of the noise put on simulated observations, by default that which the data declares."""
    if asked == "estimated":
        return problem.estimated_noise
    share = problem.dataset.disturbance.noise if asked is None else float(asked)
    # Of the clean change: noise of both readings is part of the logged one.
    return share / np.sqrt(1.0 + 2.0 * share**2) * problem.typical_change


def observation_warnings(
    problem: CalibrationProblem, window: int, deviation: Float[np.ndarray, " observation"], starts: str
) -> tuple[str, ...]:
    """Assumptions behind the estimate where observations are partial or noisy, one sentence each."""
    sentences = []
    if problem.states.kind != "exact":
        sentences.append(f"states cannot be rebuilt from the data: discriminators see windows of {window} rows")
        if starts == "logged":
            sentences.append("rollouts start at states whose velocities were taken from positions, which is not exact")
    if deviation.any():
        share = 100.0 * np.median(deviation / problem.typical_change)
        sentences.append(f"simulated observations were given sensor noise of {share:.2g} % of a step's change")
    return tuple(sentences)
