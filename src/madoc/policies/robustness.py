"""How a policy does where the estimate is not sure: over draws of it, and under an error of each parameter alone."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.evaluation import evaluate
from madoc.policies.base import NormalParameters
from madoc.simulation.base import Simulator
from madoc.types import Policy

EPISODES_OF_A_DRAW = 4
"""Episodes in each drawn system, from the same starts in all of them."""
WORST = 0.1
"""Share of the drawn systems that counts as the worst."""


@dataclass(frozen=True)
class OverDraws:
    """The return in systems drawn from the calibrated distribution.

    Attributes:
        at_estimate: Return at the mean of the distribution, from the same starts.
        mean: Mean over all systems.
        worst_tenth: Mean over the tenth of the systems in which it is lowest.
        draws: Number of systems.
    """

    at_estimate: float
    mean: float
    worst_tenth: float
    draws: int


@dataclass(frozen=True)
class ErrorCost:
    """The return that a policy loses where one parameter is off by half the width of its 95 % interval.

    Attributes:
        half_width: That error, in the parameter's unit.
        below: Return at the estimate less that with the parameter lower; negative where the return grows.
        below_error: Its standard error over episodes from the same starts.
        above: The same with the parameter higher.
        above_error: Its standard error.
    """

    half_width: float
    below: float
    below_error: float
    above: float
    above_error: float

    @property
    def largest(self) -> float:
        """What the error costs on its worse side."""
        return max(self.below, self.above)


def over_draws(
    policy: Policy, simulator: Simulator, distribution: NormalParameters, *, key: PRNGKeyArray, draws: int
) -> OverDraws:
    """The return at the mean of a distribution and in `draws` systems of it, each with the same starts."""
    of_systems, of_episodes = jax.random.split(key)
    systems = np.concatenate([distribution.mean[None], distribution.draw(of_systems, draws)])
    at_estimate, *returns = _returns(policy, simulator, systems, of_episodes, EPISODES_OF_A_DRAW).mean(1).tolist()
    worst = sorted(returns)[: max(1, round(WORST * draws))]
    return OverDraws(at_estimate, float(np.mean(returns)), float(np.mean(worst)), draws)


def costs_of_errors(
    policy: Policy,
    simulator: Simulator,
    estimate: Float[np.ndarray, " parameters"],
    half_widths: Float[np.ndarray, " parameters"],
    *,
    key: PRNGKeyArray,
    episodes: int,
) -> dict[str, ErrorCost]:
    """What an error of one half-width costs, parameter by parameter, the others at the estimate.

    Every system is given the same starts (common random numbers), at least two, so that the difference of two returns
    is that of the systems. A parameter is moved as far as its range allows.
    """
    space = simulator.parameters
    moves = np.diag(half_widths)
    systems = np.clip(np.concatenate([estimate[None], estimate - moves, estimate + moves]), space.low, space.high)
    returns = _returns(policy, simulator, systems, key, max(2, episodes))
    lost = returns[0] - returns[1:]
    below, above = np.split(lost.mean(1), 2)
    below_error, above_error = np.split(lost.std(1, ddof=1) / np.sqrt(lost.shape[1]), 2)
    columns = zip(half_widths, below, below_error, above, above_error, strict=True)
    return {name: ErrorCost(*map(float, row)) for name, row in zip(space.names, columns, strict=True)}


def _returns(
    policy: Policy,
    simulator: Simulator,
    systems: Float[np.ndarray, "systems parameters"],
    key: PRNGKeyArray,
    episodes: int,
) -> Float[np.ndarray, "systems episodes"]:
    """Returns of whole episodes in each system, from the same starts in all."""
    count = episodes * len(systems)
    outcome = evaluate(policy, simulator, systems, key=key, episodes=count, common_starts=True)
    return outcome.returns.reshape(len(systems), episodes)
