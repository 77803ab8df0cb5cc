"""Where Madoc's simulated rows come from: three ways to start, and the buffer they are kept in."""

from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.learning import replay
from madoc.simulation.rollout import (
    Rollout,
    Starts,
    Walkers,
    chosen_states,
    replay_actions,
    reset_states,
    roll,
    unbiased_starts,
)
from madoc.types import Policy

StartMode = Literal["policy", "logged", "replay"]
Features = Literal["standardised", "raw"]


def starts_of(problem: CalibrationProblem, mode: StartMode) -> Starts:
    """Where rows start and start again: at the task's resets (`policy`), else at logged states."""
    return reset_states(problem.simulator) if mode == "policy" else chosen_states(problem.logged_states)


def collect(
    problem: CalibrationProblem,
    mode: StartMode,
    policy: Policy,
    draws: Float[np.ndarray, "systems d"],
    walkers: Walkers,
    *,
    steps: int,
    keys: tuple[PRNGKeyArray, PRNGKeyArray],
) -> tuple[Rollout, Walkers]:
    """Rows under the given draws in [-1, 1], axes (steps, systems, rows).

    Args:
        problem: Data and simulator.
        mode: `replay` takes one step from logged states under the actions logged there; the others let the
            policy act from where the walkers stand.
        policy: The running policy.
        draws: One system each.
        walkers: Where rows stand, of `logged` at states rebuilt from the log; `replay` only takes their number.
        steps: Control steps per row; 1 for `replay`.
        keys: Randomness of the actions, and of the restarts.
    """
    simulator = problem.simulator
    system = simulator.bind(simulator.parameters.to_physical(draws))
    if mode == "replay":
        states, actions = problem.logged_states, problem.logged_actions
        rows = walkers.age.shape[1]
        return replay_actions(system, simulator.task, states, actions, rows=rows, key=keys[0]), walkers
    starts = starts_of(problem, mode)
    if mode == "logged":  # every walker stands at a logged state
        starts, walkers = unbiased_starts(system, starts), replace(walkers, state=system.unbiased(walkers.state))
    return roll(
        system,
        simulator.task,
        policy,
        walkers,
        steps=steps,
        starts=starts,
        key=keys[0],
        restart_key=keys[1],
    )


def empty_rows(problem: CalibrationProblem, capacity: int) -> replay.Replay:
    """A buffer of features, the draw each row was simulated under, and which parameter was moved for it."""
    task = problem.simulator.task
    return replay.empty(
        capacity,
        pair=(task.observation_size + problem.simulator.action_size,),
        following=(task.observation_size,),
        parameters=(len(problem.simulator.parameters),),
        identity=(),
    )


def remember(
    rows: replay.Replay,
    problem: CalibrationProblem,
    features: Features,
    rollout: Rollout,
    *,
    draws: Float[np.ndarray, "systems d"],
    identity: Int[np.ndarray, " systems"],
) -> replay.Replay:
    """Add a rollout's valid rows, each with its system's draw and moved parameter."""
    pair, following = problem.scalings[features].features(rollout.transitions)
    shape = rollout.valid.shape
    columns = {
        "pair": pair,
        "following": following,
        "parameters": np.broadcast_to(draws[:, None], (*shape, draws.shape[1])),
        "identity": np.broadcast_to(identity[:, None], shape),
    }
    flat = {name: replay.flatten_rows(column, 3) for name, column in columns.items()}
    return replay.add(rows, flat, rollout.valid.reshape(-1))
