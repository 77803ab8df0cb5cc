"""Walker2d: two legs, six motors, must not fall."""

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
HEALTHY_HEIGHT = (0.8, 2.0)
HEALTHY_ANGLE = 1.0
BODIES = ("torso", "thigh", "leg", "foot", "thigh_left", "leg_left", "foot_left")
JOINTS = ("thigh_joint", "leg_joint", "foot_joint", "thigh_left_joint", "leg_left_joint", "foot_left_joint")
HEAVY = ("torso", "thigh", "thigh_left")

# "normal" is the paper's own (its code). "easy" and "hard" are by analogy with Hopper: masses 1 and 4 kg
# wide about the same centres, gravity as everywhere, damping of two thirds and four thirds the width.
RANGES = {
    "easy": ((-15, -5), (3.5, 4.5), (2.5, 3.5), (0, 0.33)),
    "normal": ((-30, 0), (3, 5), (2, 4), (0, 0.5)),
    "hard": ((-50, 0), (2, 6), (1, 5), (0, 0.67)),
}


def walker2d(physics: str = "legacy") -> Task:
    """The Walker2d of D4RL and Gymnasium v2 to v4: 17 observations, 6 motors, 14 parameters."""
    spaces = {
        level: paper_space(
            gravity,
            {body: heavy if body in HEAVY else light for body in BODIES},
            dict.fromkeys(JOINTS, damping),
        )
        for level, (gravity, heavy, light, damping) in RANGES.items()
    }
    return Task(
        name="walker2d",
        physics=physics,
        spec=partial(load_robot, "walker2d.xml", physics),
        frame_skip=4,
        observation_size=17,
        observe=observe_clipped,
        reward=reward,
        terminated=terminated,
        reset_noise=reset_noise,
        parameters=spaces["normal"],
        ranges=spaces,
        groups=6,
        max_episode_steps=1000,
        reference_returns=(1.629008, 4592.3),
        state_from_observation=planar_state_from_observation,
        rebuildable=partial(observe_is_unclipped, positions=8),
        velocities=9,
    )


def reward(state: Batch, action: Batch, next_state: Batch) -> Batch:
    """Forward speed (m/s), 1 for being healthy, less 0.001 of the squared action (Gymnasium v5)."""
    return healthy_reward(state, action, next_state, ~terminated(next_state), dt=CONTROL_STEP, cost=1e-3)


def terminated(next_state: Batch) -> Batch:
    """Fallen: height outside (0.8, 2) m or tilted by more than 1 rad."""
    height, angle = next_state[..., 1], next_state[..., 2]
    low, high = HEALTHY_HEIGHT
    return ~((height > low) & (height < high) & (abs(angle) < HEALTHY_ANGLE))


def reset_noise(key: PRNGKeyArray, count: int) -> jax.Array:
    """Uniform ±0.005 on positions and velocities."""
    return uniform_noise(key, count, size=18, scale=5e-3)
