"""Ant: four legs, eight motors, must keep its torso up."""

from functools import partial

import jax
from jaxtyping import PRNGKeyArray

from madoc.tasks.base import Batch, Task, healthy_reward, paper_space
from madoc.tasks.physics import load_robot
from madoc.tasks.planar import always_rebuildable, uniform_and_normal_noise

CONTROL_STEP = 0.05
HEALTHY_HEIGHT = (0.2, 1.0)
# Bodies 1-7 of the paper's Table 9. The lower legs have no name of their own: their joints name them.
BODIES = ("torso", "front_left_leg", "aux_1", "ankle_1", "front_right_leg", "aux_2", "ankle_2")
JOINTS = ("hip_1", "ankle_1", "hip_2", "ankle_2")

# "normal" is the paper's Table 9. "easy" and "hard" are by analogy with Hopper: half and twice the width.
RANGES = {
    "easy": ((-15, -5), (0.2, 0.45), (0.02, 0.07), (0, 2)),
    "normal": ((-30, 0), (0, 0.5), (0, 0.1), (0, 3)),
    "hard": ((-50, 0), (0, 1.0), (0, 0.2), (0, 4)),
}


def ant(physics: str = "legacy") -> Task:
    """The Ant of D4RL without its always-zero contact forces: 27 observations, 8 motors, 12 parameters."""
    spaces = {
        level: paper_space(
            gravity,
            {body: torso if body == "torso" else legs for body in BODIES},
            dict.fromkeys(JOINTS, damping),
        )
        for level, (gravity, torso, legs, damping) in RANGES.items()
    }
    return Task(
        name="ant",
        physics=physics,
        spec=partial(load_robot, "ant.xml", physics),
        frame_skip=5,
        observation_size=27,
        observe=observe,
        reward=reward,
        terminated=terminated,
        reset_noise=reset_noise,
        parameters=spaces["normal"],
        ranges=spaces,
        groups=6,
        max_episode_steps=1000,
        reference_returns=(-325.6, 3879.7),
        state_from_observation=state_from_observation,
        rebuildable=always_rebuildable,
        velocities=14,
    )


def observe(state: Batch) -> Batch:
    """Every position but x and y, then the velocities. (..., 29) -> (..., 27)."""
    return state[..., 2:]


def state_from_observation(observation: Batch) -> Batch:
    """The state with x = y = 0. (..., 27) -> (..., 29)."""
    namespace = observation.__array_namespace__()
    return namespace.concat([namespace.zeros_like(observation[..., :2]), observation], axis=-1)


def reward(state: Batch, action: Batch, next_state: Batch) -> Batch:
    """Forward speed (m/s), 1 for being healthy, less 0.5 of the squared action.

    Gymnasium's without the contact cost, which mujoco-py 2.x (D4RL) always had as zero.
    """
    return healthy_reward(state, action, next_state, ~terminated(next_state), dt=CONTROL_STEP, cost=0.5)


def terminated(next_state: Batch) -> Batch:
    """Torso outside [0.2, 1] m, or a coordinate that is not finite."""
    height = next_state[..., 2]
    low, high = HEALTHY_HEIGHT
    finite = (abs(next_state) < float("inf")).all(-1)
    return ~(finite & (height >= low) & (height <= high))


def reset_noise(key: PRNGKeyArray, count: int) -> jax.Array:
    """Uniform ±0.1 on positions, normal with deviation 0.1 on velocities."""
    return uniform_and_normal_noise(key, count, positions=15, velocities=14, scale=0.1)
