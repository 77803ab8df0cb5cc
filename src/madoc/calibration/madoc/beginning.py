"""Where the actors begin: at the standard normal of the paper, or at the estimate of another method."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from madoc.calibration.base import CalibrationProblem, Prior
from madoc.calibration.madoc.actors import Actors, initial_actors
from madoc.errors import listed
from madoc.parameters import ParameterSpace

NARROWEST = 0.1
"""Smallest deviation in [-1, 1] with which actors begin at a prior, so that they can leave one that is too sure."""
WIDEST = 0.5
"""Deviation in [-1, 1] from which on a prior tells nothing: a 95 % interval is then about as wide as the range."""
FARTHEST = 0.95
"""Largest absolute value in [-1, 1] at which actors begin: nearer to an end tanh is flat."""


def first_actors(problem: CalibrationProblem) -> Actors:
    """Actors at the problem's prior, squashed of its means and deviations; those of the paper where it tells nothing.

    The deviations are at least `NARROWEST`, and before squashing at most 1.
    """
    space, prior = problem.simulator.parameters, problem.prior
    if prior is None:
        return initial_actors(len(space))
    point = np.clip(space.to_unit(prior.mean), -FARTHEST, FARTHEST)
    slope = 1.0 - point**2  # of tanh
    deviation = np.minimum(np.maximum(_scaled(space, prior), NARROWEST) / slope, 1.0)
    known = _known(space, prior)
    mean, std = np.where(known, np.arctanh(point), 0.0), np.where(known, deviation, 1.0)
    return Actors(jnp.asarray(mean, jnp.float32), jnp.asarray(np.log(std), jnp.float32))


def sentence(problem: CalibrationProblem) -> str | None:
    """Where the actors begin, if the problem has a prior."""
    space, prior = problem.simulator.parameters, problem.prior
    if prior is None:
        return None
    open_ones = [name for name, known in zip(space.names, _known(space, prior), strict=True) if not known]
    if len(open_ones) == len(space):
        return f"Madoc began at the middle of every range, as {prior.origin} leaves all parameters open"
    but = f"; it leaves {listed(open_ones)} open, which began at the middle of the range" if open_ones else ""
    return f"Madoc began at {prior.origin}{but}"


def told(problem: CalibrationProblem) -> Bool[Array, " d"] | None:
    """Of which parameters the problem's prior tells anything; None without one."""
    return None if problem.prior is None else jnp.asarray(_known(problem.simulator.parameters, problem.prior))


def _known(space: ParameterSpace, prior: Prior) -> Bool[np.ndarray, " d"]:
    """Of which parameters the prior tells anything."""
    return _scaled(space, prior) < WIDEST


def _scaled(space: ParameterSpace, prior: Prior) -> Float[np.ndarray, " d"]:
    """The prior's deviations in [-1, 1] of the ranges."""
    return 2.0 * prior.std / (space.high - space.low)
