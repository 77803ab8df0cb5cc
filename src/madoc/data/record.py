"""Recording of datasets: a policy acts in a simulated target."""

from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from madoc.data.dataset import Dataset, close_episodes, starts_after
from madoc.errors import MadocError
from madoc.simulation.base import Simulator
from madoc.simulation.rollout import begin, reset_states, roll
from madoc.types import Policy

WALKERS = 100
"""Number of episodes recorded at a time, at most."""
_BLOCK = 100
"""Number of control steps between two reports of progress."""


def record(
    policy: Policy,
    simulator: Simulator,
    true_parameters: dict[str, float],
    *,
    transitions: int,
    key: PRNGKeyArray,
    origin: str,
    advance: Callable[[int], None] = lambda rows: None,
) -> Dataset:
    """Transitions of a policy whose actions are sampled in the target, the simulator bound to `true_parameters`.

    An episode runs from the task's reset to a fall, to the time limit, or to the end of the recording, which truncates
    it. The true parameters are physical values by name, and are kept in the dataset. `advance` is called with the
    number of new rows.

    Raises:
        MadocError: The simulation diverges, or `transitions` is not positive.
    """
    if transitions < 1:
        raise MadocError(f"expected at least 1 transition to record, got {transitions}")
    truth = simulator.parameters.vector(true_parameters)
    system = simulator.bind(truth[None])
    starts = reset_states(simulator)
    rows = min(WALKERS, max(1, transitions // simulator.task.max_episode_steps))
    length = -(-transitions // rows)
    of_start, of_action, of_restart = jax.random.split(key, 3)
    walkers = begin(starts, of_start, systems=1, rows=rows)
    blocks = []
    for block in range(0, length, _BLOCK):
        rollout, walkers = roll(
            system,
            simulator.task,
            policy,
            walkers,
            steps=min(_BLOCK, length - block),
            starts=starts,
            key=jax.random.fold_in(of_action, block),
            restart_key=jax.random.fold_in(of_restart, block),
        )
        if rollout.failures:
            raise MadocError(
                f"the target {simulator.task.name} diverges under its true parameters ({rollout.failures} rows); "
                "check the values"
            )
        blocks.append(rollout.transitions)
        advance(rollout.valid.size)
    seen = jax.tree.map(lambda *columns: _one_walker_after_another(columns), *blocks)
    ends = np.asarray(seen.terminated | seen.truncated).copy()
    ends[length - 1 :: length] = True
    starts_at = starts_after(ends[:transitions])
    kept = close_episodes(seen.take(slice(transitions)), starts_at)
    return Dataset(kept, starts_at, simulator.task.name, simulator.task.physics, origin, dict(true_parameters))


def _one_walker_after_another(columns: tuple[np.ndarray, ...]) -> np.ndarray:
    """Blocks of (steps, 1, rows, ...) as (rows * all steps, ...)."""
    column = np.concatenate(columns)[:, 0]
    return np.swapaxes(column, 0, 1).reshape(-1, *column.shape[2:])
