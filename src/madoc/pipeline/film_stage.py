"""A film of policies: what each does with the robot in one episode, from the same start, for the report to draw."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray, UInt8

from madoc.runs.files import replacing
from madoc.simulation import Simulator
from madoc.simulation.outlines import outlines
from madoc.simulation.pictures import pictures, side_camera
from madoc.simulation.rollout import act, reset_states
from madoc.types import Policy

FILM = "film.npz"
"""Name of the file in a run folder."""
FRAMES = 9
"""Frames of an episode, evenly spread over the time limit."""
WIDTH = 168
"""Width of a picture in pixels."""
MOST = 1.6
"""Largest ratio of a picture's width to its height; the smallest is 1 / MOST."""


def leave_film(
    folder: Path,
    policies: Mapping[str, Policy],
    simulator: Simulator,
    parameters: Float[np.ndarray, " parameters"],
    key: PRNGKeyArray,
) -> None:
    """Let each policy act one episode in a system, and leave `film.npz`.

    It has `names` of the policies, `time` of the frames (s), `ends` (policies, frames, geoms, 2, xyz) in m, NaN after
    an episode has ended, and the `radius` of each geom in m. Where OpenGL is to be had it has `pictures` as well, RGBA
    of (policies, frames, height, width), which depend on the machine that draws them as no result does.
    """
    model, task = simulator.model(parameters), simulator.task
    steps = np.linspace(0, task.max_episode_steps, FRAMES).round().astype(int)
    of_start, _ = jax.random.split(key)
    start = reset_states(simulator)(of_start, 1)[None]
    films, shown, radius = [], [], np.empty(0)
    for policy in policies.values():
        states = _states(policy, simulator, parameters, start)
        seen = steps[steps < len(states)]
        ends, radius = outlines(model, states[seen])
        films.append(np.concatenate([ends, np.full((FRAMES - len(seen), *ends.shape[1:]), np.nan)]))
        shown.append(states[seen])
    ends = np.stack(films)
    drawn = _pictures(simulator, parameters, shown, ends, radius)
    with replacing(folder / FILM) as stream:
        np.savez_compressed(
            stream,
            allow_pickle=False,
            names=np.array(list(policies)),
            time=simulator.control_step * steps,
            ends=ends,
            radius=radius,
            **({} if drawn is None else {"pictures": drawn}),
        )


def _pictures(
    simulator: Simulator,
    parameters: Float[np.ndarray, " parameters"],
    states: Sequence[Float[np.ndarray, "_ state"]],
    ends: Float[np.ndarray, "policies frames geoms 2 xyz"],
    radius: Float[np.ndarray, " geoms"],
) -> UInt8[np.ndarray, "policies frames height width 4"] | None:
    """Pictures of the states of each policy, all seen alike, empty after its episode's end; None without OpenGL."""
    model, shown = simulator.model(parameters), np.isfinite(ends).all((2, 3, 4))
    if not len(radius):
        return None
    camera, ratio = side_camera(ends[shown], radius, float(model.vis.global_.fovy), MOST)
    drawn = pictures(model, np.concatenate(states), camera, width=WIDTH, height=round(WIDTH / ratio))
    if drawn is None:
        return None
    whole = np.zeros((*shown.shape, *drawn.shape[1:]), dtype=np.uint8)
    whole[shown] = drawn
    return whole


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
