"""Insensitive parameters: those that change no next state are found before any budget is spent on them."""

import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from madoc.errors import MadocError
from madoc.simulation.base import Simulator
from madoc.types import generator

ROWS = (64, 512, 4096)
"""Number of logged rows in which a parameter is tried, one after the other as long as it changes nothing: contacts may
be rare."""


def insensitive(
    simulator: Simulator,
    states: Float[np.ndarray, "logged state"],
    actions: Float[np.ndarray, "logged action"],
    *,
    key: PRNGKeyArray,
) -> list[str]:
    """The names of parameters that change no bit of any next state or observation at either end of their range.

    All other parameters stay at mid-range. At most the last of `ROWS` logged rows are drawn without repetition, and a
    row counts only where both simulations succeeded. No rows, or rows that all fail at mid-range, are refused.
    """
    if not len(states):
        raise MadocError("expected at least one logged state to test the parameters at, got none")
    order = generator(key).permutation(len(states))
    left, before = list(range(len(simulator.parameters))), 0
    for rows in ROWS:
        chosen, before = order[before:rows], rows
        if not left or not len(chosen):
            break
        changed = _changed(simulator, states[chosen], actions[chosen], left)
        left = [index for index, felt in zip(left, changed, strict=True) if not felt]
    return [simulator.parameters.names[index] for index in left]


def _changed(
    simulator: Simulator,
    states: Float[np.ndarray, "rows state"],
    actions: Float[np.ndarray, "rows action"],
    tried: list[int],
) -> Bool[np.ndarray, " tried"]:
    """Whether each of these parameters changes a next state or an observation in any of the rows."""
    space = simulator.parameters
    # Mid-range, then each parameter in turn at its low and at its high end.
    moves = np.kron(np.eye(len(space))[tried], [[-1.0], [1.0]])
    ends = space.to_physical(np.vstack([np.zeros(len(space)), moves]))
    state, action = (np.repeat(logged[None], len(ends), axis=0) for logged in (states, actions))
    system = simulator.bind(ends)
    next_states = system.step(system.unbiased(state), action)
    following = np.concatenate([next_states, system.observe(next_states)], axis=-1)
    middle, moved = following[0], following[1:]
    if not np.isfinite(middle).all(-1).any():
        raise MadocError(
            f"{simulator.task.name}: the simulation fails in all {len(states)} rows at mid-range parameters; "
            "check the ranges and the states"
        )
    comparable = np.isfinite(moved).all(-1) & np.isfinite(middle).all(-1)
    felt: Bool[np.ndarray, " tried"] = ((moved != middle).any(-1) & comparable).any(-1).reshape(-1, 2).any(-1)
    return felt


def refuse_insensitive(
    simulator: Simulator,
    states: Float[np.ndarray, "logged state"],
    actions: Float[np.ndarray, "logged action"],
    *,
    key: PRNGKeyArray,
) -> None:
    """Check that every parameter changes some next state.

    Raises:
        MadocError: A parameter changes none, so no method could calibrate it.
    """
    names = insensitive(simulator, states, actions, key=key)
    if names:
        what = f"parameter {names[0]} changes" if len(names) == 1 else f"parameters {', '.join(names)} change"
        remedy = "remove it or widen its range" if len(names) == 1 else "remove them or widen their ranges"
        raise MadocError(f"{what} no next state in {min(ROWS[-1], len(states)):,} logged rows; {remedy}")
