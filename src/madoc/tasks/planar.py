"""What the planar robots share: they walk along x, and x never enters their dynamics."""

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from madoc.tasks.base import Batch

VELOCITY_CLIP = 10.0


def observe_clipped(state: Batch) -> Batch:
    """Hopper, Walker2d: every position but x, then velocities clipped to ±10. (..., 2n) -> (..., 2n - 1)."""
    namespace = state.__array_namespace__()
    size = state.shape[-1] // 2
    velocity = namespace.clip(state[..., size:], -VELOCITY_CLIP, VELOCITY_CLIP)
    return namespace.concat([state[..., 1:size], velocity], axis=-1)


def observe_without_x(state: Batch) -> Batch:
    """HalfCheetah: every position but x, then the velocities. (..., 2n) -> (..., 2n - 1)."""
    return state[..., 1:]


def planar_state_from_observation(observation: Batch) -> Batch:
    """The state with x = 0. (..., 2n - 1) -> (..., 2n)."""
    namespace = observation.__array_namespace__()
    return namespace.concat([namespace.zeros_like(observation[..., :1]), observation], axis=-1)


def observe_is_unclipped(observation: Batch, positions: int) -> Batch:
    """Whether no velocity of the row stands at the clip: only then can its state be rebuilt."""
    return (abs(observation[..., positions:]) < VELOCITY_CLIP).all(-1)


def always_rebuildable(observation: Batch) -> Batch:
    """Every row determines its state."""
    return np.ones(observation.shape[:-1], dtype=bool)


def uniform_noise(key: PRNGKeyArray, count: int, *, size: int, scale: float) -> jax.Array:
    """Offsets of an initial state, uniform in ±scale, shape (count, size)."""
    return jax.random.uniform(key, (count, size), minval=-scale, maxval=scale)


def uniform_and_normal_noise(
    key: PRNGKeyArray, count: int, *, positions: int, velocities: int, scale: float
) -> jax.Array:
    """Offsets of an initial state: positions uniform in ±scale, velocities normal with deviation scale."""
    of_position, of_velocity = jax.random.split(key)
    uniform = jax.random.uniform(of_position, (count, positions), minval=-scale, maxval=scale)
    normal = scale * jax.random.normal(of_velocity, (count, velocities))
    return jax.numpy.concatenate([uniform, normal], axis=-1)
