"""Where Madoc's simulated rows come from: three ways to start, and the buffer they are kept in."""

from dataclasses import replace
from typing import Literal

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.learning import replay
from madoc.learning.window_features import WindowScaling, rolled_stretch, unbroken
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
from madoc.simulation.velocities import refuse_unseen_positions
from madoc.types import Policy

StartMode = Literal["policy", "logged", "replay"]
Features = Literal["standardised", "raw"]


def starts_of(problem: CalibrationProblem, mode: StartMode) -> Starts:
    """Where rows start and start again: at the task's resets (`policy`), else at logged states.

    Where logged states cannot be rebuilt, their velocities are taken from positions.

    Raises:
        MadocError: Positions are not known either, or not all of them.
    """
    if mode == "policy":
        return reset_states(problem.simulator)
    if mode == "logged" and problem.states.kind != "exact":
        refuse_unseen_positions(problem.simulator.task)
        return chosen_states(problem.states.guesses()[0])
    return chosen_states(problem.logged_states)


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


def empty_rows(problem: CalibrationProblem, scaling: WindowScaling, capacity: int) -> replay.Replay:
    """A buffer of features, the draw each row was simulated under, and which parameter was moved for it."""
    window, following = scaling.sizes
    return replay.empty(
        capacity,
        pair=(window,),
        following=(following,),
        parameters=(len(problem.simulator.parameters),),
        identity=(),
    )


def remember(
    rows: replay.Replay,
    scaling: WindowScaling,
    rollout: Rollout,
    *,
    draws: Float[np.ndarray, "systems d"],
    identity: Int[np.ndarray, " systems"],
) -> replay.Replay:
    """Add a rollout's windows, each with its system's draw and moved parameter."""
    seen = rollout.transitions
    window, following = scaling.features(rolled_stretch(seen, scaling.length))
    ended = np.asarray(seen.terminated) | np.asarray(seen.truncated)
    whole = unbroken(rollout.valid, ended, scaling.length)
    columns = {
        "pair": window,
        "following": following,
        "parameters": np.broadcast_to(draws[:, None], (*whole.shape, draws.shape[1])),
        "identity": np.broadcast_to(identity[:, None], whole.shape),
    }
    flat = {name: replay.flatten_rows(column, 3) for name, column in columns.items()}
    return replay.add(rows, flat, whole.reshape(-1))


def sensed(rollout: Rollout, deviation: Float[np.ndarray, " observation"], key: PRNGKeyArray) -> Rollout:
    """The rollout as sensors that noisy would have shown it; a reading that ends one row begins the next.

    What the policy acted on stays as it was.
    """
    if not deviation.any():
        return rollout
    seen = rollout.transitions
    steps, *others = np.shape(seen.observation)
    noise = deviation * np.asarray(jax.random.normal(key, (steps + 1, *others)), np.float64)
    noisy = replace(seen, observation=seen.observation + noise[:-1], next_observation=seen.next_observation + noise[1:])
    return replace(rollout, transitions=noisy)
