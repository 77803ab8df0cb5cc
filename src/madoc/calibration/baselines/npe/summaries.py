"""What is seen of logged and of simulated rows: moments of sets of windows."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.baselines.npe.emulator import Cosines, Emulator, moments
from madoc.calibration.baselines.npe.moments import Sets
from madoc.calibration.sensing import rows_compared

_BLOCK = 2000
"""Logged windows whose moments are in memory at a time."""


def unpaired(problem: CalibrationProblem) -> bool:
    """Whether it is not known which next observation belongs to which row."""
    return problem.dataset.disturbance.shuffled == "next_observations"


def set_moments(
    problem: CalibrationProblem,
    emulator: Emulator,
    features: Cosines,
    window: Float[np.ndarray, "*sets rows window"],
    following: Float[np.ndarray, "*sets rows observation"],
    counted: Bool[np.ndarray, "*sets rows"],
) -> Sets:
    """Moments of sets of rows, of the rows that are `counted`."""
    scaling, _ = problem.features.windows("standardised", rows_compared(problem))
    ratio = jnp.asarray(scaling.next_scale / scaling.scaling.pair_scale[: following.shape[-1]], jnp.float32)
    sets = counted.shape[:-1]
    windows, followings, weights = (
        jnp.asarray(part.reshape(-1, *part.shape[len(sets) :]), jnp.float32) for part in (window, following, counted)
    )
    marginals = (features, ratio) if unpaired(problem) else None
    means = moments(emulator, windows, followings, weights, marginals)
    return Sets(*(np.asarray(part, np.float64).reshape(*sets, *part.shape[1:]) for part in means))


def logged_moments(problem: CalibrationProblem, emulator: Emulator, features: Cosines) -> Sets:
    """Moments of the whole log. Where pairs are unknown, all of its rows still have all of its next observations."""
    window, following = map(np.asarray, problem.features.windows("standardised", rows_compared(problem))[1])
    count, block = len(window), min(_BLOCK, len(window))
    index = np.arange(count + -count % block).reshape(-1, block)
    rows = np.minimum(index, count - 1)
    return set_moments(problem, emulator, features, window[rows], following[rows], index < count).joined(0)


def by_halves(part: np.ndarray) -> np.ndarray:
    """(steps, draws, rows, ...) as (draws, 2, steps of half of the rows, ...); an odd row is left out."""
    steps, draws, rows = part.shape[:3]
    half = rows // 2
    return np.moveaxis(part, 0, 2)[:, : 2 * half].reshape(draws, 2, half * steps, *part.shape[3:])
