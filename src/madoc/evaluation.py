"""Returns of a policy in a system, the normalized score, and the error of an estimate. Only here is the truth read."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.parameters import ParameterSpace
from madoc.simulation.base import Simulator
from madoc.simulation.rollout import act, reset_states
from madoc.types import Policy


@dataclass(frozen=True)
class Returns:
    """Undiscounted returns, and D4RL's normalized scores 100 (return - random) / (expert - random) (Fu et al. 2020).

    Each array has one value for each episode; `lengths` are in control steps.
    """

    returns: Float[np.ndarray, " episodes"]
    lengths: Float[np.ndarray, " episodes"]
    normalized: Float[np.ndarray, " episodes"]

    def summary(self) -> dict[str, float]:
        """Means and the standard deviation of the return, for JSON."""
        return {
            "return": float(self.returns.mean()),
            "return_std": float(self.returns.std()),
            "normalized": float(self.normalized.mean()),
            "length": float(self.lengths.mean()),
            "episodes": len(self.returns),
        }


def evaluate(
    policy: Policy,
    simulator: Simulator,
    parameters: Float[np.ndarray, "*systems parameters"] | Mapping[str, float],
    *,
    key: PRNGKeyArray,
    episodes: int = 10,
    deterministic: bool = True,
    common_starts: bool = False,
    advance: Callable[[int], None] = lambda steps: None,
) -> Returns:
    """Returns of whole episodes, simulated at the same time; an episode whose simulation fails ends there.

    The parameters are physical values of one system, by name or as a vector, or of several, one in each row. Every
    system gets the same number of episodes, in sum at least `episodes`; with `common_starts`, from the same starts, so
    that differences between systems are not those of starts. `advance` is called with the number of further
    control steps, of the task's `max_episode_steps`, that are done.
    """
    task = simulator.task
    of_start, of_action = jax.random.split(key)
    system = simulator.bind(np.atleast_2d(simulator.parameters.vector(parameters)))
    rows = -(-episodes // system.count)
    starts = reset_states(simulator)(of_start, rows if common_starts else system.count * rows)
    state = np.broadcast_to(starts, (system.count, *starts.shape)) if common_starts else starts
    state = state.reshape(system.count, rows, -1)
    alive = np.ones((system.count, rows), dtype=bool)
    total, length = np.zeros(alive.shape), np.zeros(alive.shape)
    for step in range(task.max_episode_steps):
        stream = None if deterministic else of_action
        action = np.asarray(act(policy, system.observe(state), stream, np.int32(step)), dtype=np.float64)
        next_state = system.step(state, action)
        alive &= np.isfinite(next_state).all(-1)
        next_state = np.where(alive[..., None], next_state, state)
        total += np.where(alive, task.reward(state, action, next_state), 0.0)
        length += alive
        alive &= ~task.terminated(next_state)
        state = next_state
        if not alive.any():
            advance(task.max_episode_steps - step)
            break
        advance(1)
    returns = total.reshape(-1)
    random, expert = task.reference_returns
    return Returns(returns, length.reshape(-1), 100.0 * (returns - random) / (expert - random))


def calibration_error(
    estimate: Float[np.ndarray, " parameters"], truth: Float[np.ndarray, " parameters"], space: ParameterSpace
) -> dict[str, object]:
    """The error of an estimate.

    Returns:
        `mean_absolute` over values in different units, as in the paper's Table 10 (gravity dominates),
        `mean_percent_of_range`, and `per_parameter`: the absolute error of each, in its unit.
    """
    absolute = np.abs(np.asarray(estimate) - np.asarray(truth))
    return {
        "mean_absolute": float(absolute.mean()),
        "mean_percent_of_range": float((100.0 * absolute / (space.high - space.low)).mean()),
        "per_parameter": dict(zip(space.names, absolute.tolist(), strict=True)),
    }
