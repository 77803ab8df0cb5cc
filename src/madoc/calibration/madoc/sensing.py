"""What Madoc makes of partial and noisy observations: how many rows it looks at, and what its own readings carry."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from madoc.calibration.base import CalibrationProblem

HIDDEN_WINDOW = 3
"""Rows where velocities are hidden: two readings tell a velocity, a third the acceleration that it came with."""


def window_length(problem: CalibrationProblem, asked: int | None, starts: str) -> int:
    """Rows (s, a) before s': as many as asked for, else 1 where one tells the state or is replayed."""
    seen = problem.states.kind == "exact"
    return asked or (1 if seen or starts == "replay" else HIDDEN_WINDOW)


def noise_deviation(
    problem: CalibrationProblem, asked: float | Literal["estimated"] | None
) -> Float[np.ndarray, " observation"]:
    """Of the noise that simulated observations are given: as asked, looked for, or what the data says of itself."""
    if asked == "estimated":
        return problem.estimated_noise
    share = problem.dataset.disturbance.noise if asked is None else float(asked)
    # Of the clean change: noise of both readings is part of the logged one.
    return share / np.sqrt(1.0 + 2.0 * share**2) * problem.typical_change


def said_of_observations(
    problem: CalibrationProblem, window: int, deviation: Float[np.ndarray, " observation"], starts: str
) -> tuple[str, ...]:
    """What else the estimate rests on where observations are partial or noisy, one sentence each."""
    found = []
    if problem.states.kind != "exact":
        found.append(f"states cannot be rebuilt from the data: discriminators see windows of {window} rows")
        if starts == "logged":
            found.append("rollouts start at states whose velocities were taken from positions, which is not exact")
    if deviation.any():
        share = 100.0 * np.median(deviation / problem.typical_change)
        found.append(f"simulated observations were given sensor noise of {share:.2g} % of a step's change")
    return tuple(found)
