"""Hopper: one leg, three motors, must not fall."""

from functools import partial

import jax
from jaxtyping import PRNGKeyArray

from madoc.tasks.base import Batch, Task, healthy_reward, paper_space
from madoc.tasks.physics import load_robot
from madoc.tasks.planar import (
    observe_clipped,
    observe_is_unclipped,
    planar_state_from_observation,
    uniform_noise,
)

CONTROL_STEP = 0.008
HEALTHY_STATE = 100.0
HEALTHY_HEIGHT = 0.7
HEALTHY_ANGLE = 0.2
BODIES = ("torso", "thigh", "leg", "foot")
JOINTS = ("thigh_joint", "leg_joint", "foot_joint")

# Table 7, Jiang et al. 2024: gravity, masses 1-4, damping 3-5.
RANGES = {
    "easy": ((-15, -5), ((3, 4), (3.5, 4.5), (2, 3), (4.5, 5.5)), (0, 2)),
    "normal": ((-30, 0), ((3, 5), (3, 5), (2, 4), (4, 6)), (0, 3)),
    "hard": ((-50, 0), ((2, 6), (2, 6), (1, 5), (3, 7)), (0, 4)),
}


def hopper(physics: str = "legacy") -> Task:
    """The Hopper of D4RL and Gymnasium: 11 observations, 3 motors, 8 parameters."""
    spaces = {
        level: paper_space(gravity, dict(zip(BODIES, masses, strict=True)), dict.fromkeys(JOINTS, damping))
        for level, (gravity, masses, damping) in RANGES.items()
    }
    return Task(
        name="hopper",
        physics=physics,
        spec=partial(load_robot, "hopper.xml", physics),
        frame_skip=4,
        observation_size=11,
        observe=observe_clipped,
        reward=reward,
        terminated=terminated,
        reset_noise=reset_noise,
        parameters=spaces["normal"],
        ranges=spaces,
        groups=4,
        max_episode_steps=1000,
        reference_returns=(-20.272305, 3234.3),
        state_from_observation=planar_state_from_observation,
        rebuildable=partial(observe_is_unclipped, positions=5),
        velocities=6,
    )


def reward(state: Batch, action: Batch, next_state: Batch) -> Batch:
    """Forward speed (m/s), 1 for being healthy, less 0.001 of the squared action (Gymnasium v5)."""
    return healthy_reward(state, action, next_state, ~terminated(next_state), dt=CONTROL_STEP, cost=1e-3)


def terminated(next_state: Batch) -> Batch:
    """Fallen: below 0.7 m, tilted by more than 0.2 rad, or any coordinate past 100."""
    height, angle = next_state[..., 1], next_state[..., 2]
    within = (abs(next_state[..., 2:]) < HEALTHY_STATE).all(-1)
    return ~(within & (height > HEALTHY_HEIGHT) & (abs(angle) < HEALTHY_ANGLE))


def reset_noise(key: PRNGKeyArray, count: int) -> jax.Array:
    """Uniform ±0.005 on positions and velocities."""
    return uniform_noise(key, count, size=12, scale=5e-3)
