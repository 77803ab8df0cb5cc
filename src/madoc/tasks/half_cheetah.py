"""HalfCheetah: two legs, six motors, never terminates."""

from functools import partial

import jax
from jaxtyping import PRNGKeyArray

from madoc.tasks.base import Batch, Task, paper_space
from madoc.tasks.physics import load_robot
from madoc.tasks.planar import (
    always_rebuildable,
    observe_without_x,
    planar_state_from_observation,
    uniform_and_normal_noise,
)

CONTROL_STEP = 0.05
TOTAL_MASS = 14.0
BODIES = ("torso", "bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
JOINTS = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")

# Table 6, Jiang et al. 2024: gravity, masses 1-7, damping 3-8.
RANGES = {
    "easy": (
        (-15, -5),
        ((6, 7), (1, 2), (1, 2), (0.5, 1.5), (1, 2), (0.5, 1.5), (0.5, 1.5)),
        ((4.5, 7.5), (3, 6), (1.5, 4.5), (3, 6), (1.5, 4.5), (0, 3)),
    ),
    "normal": ((-30, 0), ((5, 7), *6 * ((0, 2),)), (*3 * ((1.5, 7.5),), *3 * ((0, 6),))),
    "hard": ((-50, 0), ((4, 8), *6 * ((0, 3),)), 6 * ((0, 7.5),)),
}


def half_cheetah(physics: str = "legacy") -> Task:
    """The HalfCheetah of D4RL and Gymnasium: 17 observations, 6 motors, 14 parameters."""
    spaces = {
        level: paper_space(gravity, dict(zip(BODIES, masses, strict=True)), dict(zip(JOINTS, dampings, strict=True)))
        for level, (gravity, masses, dampings) in RANGES.items()
    }
    return Task(
        name="halfcheetah",
        physics=physics,
        spec=partial(load_robot, "half_cheetah.xml", physics, TOTAL_MASS),
        frame_skip=5,
        observation_size=17,
        observe=observe_without_x,
        reward=reward,
        terminated=terminated,
        reset_noise=reset_noise,
        parameters=spaces["normal"],
        ranges=spaces,
        groups=6,
        max_episode_steps=1000,
        reference_returns=(-280.178953, 12135.0),
        state_from_observation=planar_state_from_observation,
        rebuildable=always_rebuildable,
        velocities=9,
    )


def reward(state: Batch, action: Batch, next_state: Batch) -> Batch:
    """Forward speed (m/s) less 0.1 of the squared action (Gymnasium v5)."""
    speed = (next_state[..., 0] - state[..., 0]) / CONTROL_STEP
    return speed - 0.1 * (action**2).sum(-1)


def terminated(next_state: Batch) -> Batch:
    """Never."""
    return next_state[..., 0] != next_state[..., 0]


def reset_noise(key: PRNGKeyArray, count: int) -> jax.Array:
    """Uniform ±0.1 on positions, normal with deviation 0.1 on velocities."""
    return uniform_and_normal_noise(key, count, positions=9, velocities=9, scale=0.1)
