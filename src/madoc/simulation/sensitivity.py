"""Insensitive parameters: those that change no next state are found before any budget is spent on them."""

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.errors import MadocError
from madoc.simulation.base import Simulator
from madoc.types import generator


def insensitive(
    simulator: Simulator,
    states: Float[np.ndarray, "logged state"],
    actions: Float[np.ndarray, "logged action"],
    *,
    key: PRNGKeyArray,
    rows: int = 64,
) -> tuple[list[str], int]:
    """Parameters that change no bit of any next state or observation at either end of their range.

    All other parameters stay at mid-range. At most `rows` logged rows are drawn without repetition, and a row counts
    only where both simulations succeeded. No rows, or rows that all fail at mid-range, are refused.

    Returns:
        The names, in the order of the parameters, and the control steps spent: rows · (2 d + 1).
    """
    if not len(states):
        raise MadocError("expected at least one logged state to test the parameters at, got none")
    count = min(rows, len(states))
    chosen = generator(key).permutation(len(states))[:count]
    # Mid-range, then each parameter in turn at its low and at its high end.
    space = simulator.parameters
    ends = space.to_physical(np.vstack([np.zeros(len(space)), np.kron(np.eye(len(space)), [[-1.0], [1.0]])]))
    state, action = (np.repeat(logged[chosen][None], len(ends), axis=0) for logged in (states, actions))
    system = simulator.bind(ends)
    next_states = system.step(system.unbiased(state), action)
    following = np.concatenate([next_states, system.observe(next_states)], axis=-1)
    middle, moved = following[0], following[1:]
    if not np.isfinite(middle).all(-1).any():
        raise MadocError(
            f"{simulator.task.name}: the simulation fails in all {count} rows at mid-range parameters; "
            "check the ranges and the states"
        )
    comparable = np.isfinite(moved).all(-1) & np.isfinite(middle).all(-1)
    changed = ((moved != middle).any(-1) & comparable).any(-1).reshape(-1, 2).any(-1)
    names = [name for name, felt in zip(space.names, changed, strict=True) if not felt]
    return names, len(ends) * count


def refuse_insensitive(
    simulator: Simulator,
    states: Float[np.ndarray, "logged state"],
    actions: Float[np.ndarray, "logged action"],
    *,
    key: PRNGKeyArray,
    rows: int = 64,
) -> int:
    """Check that every parameter changes some next state; returns the control steps spent on it.

    Raises:
        MadocError: A parameter changes none, so no method could calibrate it.
    """
    names, control_steps = insensitive(simulator, states, actions, key=key, rows=rows)
    if names:
        what = f"parameter {names[0]} changes" if len(names) == 1 else f"parameters {', '.join(names)} change"
        remedy = "remove it or widen its range" if len(names) == 1 else "remove them or widen their ranges"
        raise MadocError(f"{what} no next state in {min(rows, len(states))} logged rows; {remedy}")
    return control_steps
