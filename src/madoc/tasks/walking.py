"""The parts that the paper's walking robots share. The root's x (and y) position never enters their dynamics."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from madoc.parameters import Parameter, ParameterSpace
from madoc.tasks.base import Batch, Task
from madoc.tasks.physics import load_robot

VELOCITY_CLIP = 10.0
"""Bound of an observed velocity of Hopper and Walker2d in m/s or rad/s; larger ones are clipped to it."""

Span = tuple[float, float]
"""Lower and upper end of a range."""
Ranges = tuple[Span, Sequence[Span], Sequence[Span]]
"""Ranges of gravity (m/s²), of each mass (kg) and of each damping (N·m·s/rad)."""


def walking_task(
    name: str,
    file: str,
    physics: str,
    *,
    bodies: Sequence[str],
    joints: Sequence[str],
    ranges: Mapping[str, Ranges],
    positions: int,
    velocities: int,
    root: int,
    clipped: bool,
    frame_skip: int,
    reward: Callable[[Batch, Batch, Batch], Batch],
    terminated: Callable[[Batch], Batch],
    reset_noise: Callable[[PRNGKeyArray, int], jax.Array],
    groups: int,
    reference_returns: tuple[float, float],
    total_mass: float | None = None,
) -> Task:
    """A robot of the paper, from a file of Gymnasium's MuJoCo assets.

    The masses of `bodies` and the damping of `joints` are calibrated, by level within `ranges`, of which `normal` is
    the task's own. A state has `positions` and `velocities`; an observation leaves out the first `root` positions, and
    its velocities are `clipped` or not. The model's masses are scaled to `total_mass` in kg where it is given. The
    other arguments are attributes of `Task`.
    """
    spaces = {level: _space(bodies, joints, spans) for level, spans in ranges.items()}
    seen = positions - root
    return Task(
        name=name,
        physics=physics,
        spec=partial(load_robot, file, physics, total_mass),
        frame_skip=frame_skip,
        observation_size=seen + velocities,
        observe=partial(_observe, root=root, positions=positions, clipped=clipped),
        reward=reward,
        terminated=terminated,
        reset_noise=reset_noise,
        parameters=spaces["normal"],
        ranges=spaces,
        groups=groups,
        max_episode_steps=1000,
        reference_returns=reference_returns,
        state_from_observation=partial(_with_root, root=root),
        rebuildable=partial(_unclipped, positions=seen) if clipped else _always,
        velocities=velocities,
    )


def forward_reward(
    state: Batch,
    action: Batch,
    next_state: Batch,
    *,
    dt: float,
    cost: float,
    terminated: Callable[[Batch], Batch] | None = None,
) -> Batch:
    """Velocity along the first coordinate (m/s), plus 1 where not `terminated`, less `cost` · the squared action."""
    speed = (next_state[..., 0] - state[..., 0]) / dt
    healthy = speed if terminated is None else speed + ~terminated(next_state)
    return healthy - cost * (action**2).sum(-1)


def uniform_noise(key: PRNGKeyArray, count: int, *, size: int, scale: float) -> jax.Array:
    """Offsets of an initial state, uniform in ±scale, shape (count, size)."""
    return jax.random.uniform(key, (count, size), minval=-scale, maxval=scale)


def uniform_and_normal_noise(key: PRNGKeyArray, count: int, *, positions: int, velocities: int) -> jax.Array:
    """Offsets of an initial state, as Gymnasium's: positions uniform in ±0.1, velocities normal with deviation 0.1."""
    of_position, of_velocity = jax.random.split(key)
    normal = 0.1 * jax.random.normal(of_velocity, (count, velocities))
    return jax.numpy.concatenate([uniform_noise(of_position, count, size=positions, scale=0.1), normal], axis=-1)


def _space(bodies: Sequence[str], joints: Sequence[str], ranges: Ranges) -> ParameterSpace:
    """The paper's box: gravity, masses of bodies, damping of joints, in this order."""
    gravity, masses, dampings = ranges
    return ParameterSpace(
        (
            Parameter("gravity", "", *gravity),
            *(Parameter("body_mass", body, *span) for body, span in zip(bodies, masses, strict=True)),
            *(Parameter("dof_damping", joint, *span) for joint, span in zip(joints, dampings, strict=True)),
        )
    )


def _observe(state: Batch, *, root: int, positions: int, clipped: bool) -> Batch:
    """Every position but the root's, then the velocities, clipped or not."""
    if not clipped:
        return state[..., root:]
    namespace = state.__array_namespace__()
    velocity = namespace.clip(state[..., positions:], -VELOCITY_CLIP, VELOCITY_CLIP)
    return namespace.concat([state[..., root:positions], velocity], axis=-1)


def _with_root(observation: Batch, *, root: int) -> Batch:
    """The state whose root is at 0."""
    namespace = observation.__array_namespace__()
    return namespace.concat([namespace.zeros_like(observation[..., :root]), observation], axis=-1)


def _unclipped(observation: Batch, *, positions: int) -> Batch:
    """Whether no velocity of a row is at the clip: only then can its state be rebuilt."""
    return (abs(observation[..., positions:]) < VELOCITY_CLIP).all(-1)


def _always(observation: Batch) -> Batch:
    """Every row determines its state."""
    return np.ones(observation.shape[:-1], dtype=bool)
