"""How Madoc simulates rows: three ways to start rollouts, and the replay buffer of their features."""

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
from madoc.types import Policy

StartMode = Literal["policy", "logged", "replay"]
Features = Literal["standardised", "raw"]


def starts_of(problem: CalibrationProblem, mode: StartMode) -> Starts:
    """Where rollouts start, and start again: at resets of the task (`policy`), else at logged states.

    Where velocities are not observed, those of `logged` starts are finite differences of positions.

    Raises:
        MadocError: Some positions are not observed, or states to replay from are not exact.
    """
    if mode == "policy":
        return reset_states(problem.simulator)
    logged = problem.states
    return chosen_states(logged.states if mode == "logged" and logged.starts_known else logged.exact()[0])


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
        states, logged = problem.states.exact()
        actions, rows = np.asarray(problem.dataset.transitions.action)[logged], walkers.age.shape[1]
        return replay_actions(system, simulator.task, states, actions, rows=rows, key=keys[0]), walkers
    starts = starts_of(problem, mode)
    if mode == "logged":  # every walker stands at a logged state
        starts, walkers = unbiased_starts(system, starts), replace(walkers, state=system.unbiased(walkers.state))
    return roll(system, simulator.task, policy, walkers, steps=steps, starts=starts, key=keys[0], restart_key=keys[1])


def empty_rows(problem: CalibrationProblem, scaling: WindowScaling, capacity: int) -> replay.Replay:
    """A buffer of features, the draw each row was simulated under, and which parameter was moved for it."""
    window, following = scaling.sizes
    return replay.empty(
        capacity, pair=(window,), following=(following,), parameters=(len(problem.simulator.parameters),), identity=()
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
    """The rollout with sensor noise on its observations; each observation is the same at the end and start of rows.

    The policy acted on observations without noise.
    """
    if not deviation.any():
        return rollout
    seen = rollout.transitions
    steps, *others = np.shape(seen.observation)
    noise = deviation * np.asarray(jax.random.normal(key, (steps + 1, *others)), np.float64)
    noisy = replace(seen, observation=seen.observation + noise[:-1], next_observation=seen.next_observation + noise[1:])
    return replace(rollout, transitions=noisy)
