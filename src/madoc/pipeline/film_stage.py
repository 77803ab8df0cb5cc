"""A film of policies: what each does with the robot in one episode, from the same start, for the report to draw."""

from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.runs.files import replacing
from madoc.simulation import Simulator
from madoc.simulation.outlines import outlines
from madoc.simulation.rollout import act, reset_states
from madoc.types import Policy

FILM = "film.npz"
"""Name of the file in a run folder."""
FRAMES = 9
"""Frames of an episode, evenly spread over the time limit."""


def leave_film(
    folder: Path,
    policies: Mapping[str, Policy],
    simulator: Simulator,
    parameters: Float[np.ndarray, " parameters"],
    key: PRNGKeyArray,
) -> None:
    """Let each policy act one episode in a system, and leave `film.npz`.

    It has `names` of the policies, `time` of the frames (s), `ends` (policies, frames, geoms, 2, xyz) in m, NaN after
    an episode has ended, and the `radius` of each geom in m.
    """
    model, task = simulator.model(parameters), simulator.task
    steps = np.linspace(0, task.max_episode_steps, FRAMES).round().astype(int)
    of_start, _ = jax.random.split(key)
    start = reset_states(simulator)(of_start, 1)[None]
    films, radius = [], np.empty(0)
    for policy in policies.values():
        states = _states(policy, simulator, parameters, start)
        seen = steps[steps < len(states)]
        ends, radius = outlines(model, states[seen])
        films.append(np.concatenate([ends, np.full((FRAMES - len(seen), *ends.shape[1:]), np.nan)]))
    with replacing(folder / FILM) as stream:
        np.savez_compressed(
            stream,
            allow_pickle=False,
            names=np.array(list(policies)),
            time=simulator.control_step * steps,
            ends=np.stack(films),
            radius=radius,
        )


def _states(
    policy: Policy,
    simulator: Simulator,
    parameters: Float[np.ndarray, " parameters"],
    start: Float[np.ndarray, "1 1 state"],
) -> Float[np.ndarray, "steps state"]:
    """The states of one episode of a deterministic policy, the first included, up to its end."""
    system, state, states = simulator.bind(parameters), start, [start[0, 0]]
    for step in range(simulator.task.max_episode_steps):
        action = np.asarray(act(policy, system.observe(state), None, np.int32(step)), dtype=np.float64)
        state = system.step(state, action)
        if not np.isfinite(state).all():
            break
        states.append(state[0, 0])
        if simulator.task.terminated(state).all():
            break
    return np.stack(states)
