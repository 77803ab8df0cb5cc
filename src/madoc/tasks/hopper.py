"""Hopper: one leg, three motors, must not fall."""

from functools import partial

from madoc.tasks.base import Batch, Task
from madoc.tasks.walking import forward_reward, uniform_noise, walking_task

HEALTHY_STATE = 100.0
"""Bound of every coordinate but x; the task ends beyond it."""
HEALTHY_HEIGHT = 0.7
"""Lowest height of the torso in m; the task ends below it."""
HEALTHY_ANGLE = 0.2
"""Largest tilt of the torso in rad; the task ends beyond it."""

# Table 7, Jiang et al. 2024: gravity, masses 1-4, damping 3-5.
RANGES = {
    "easy": ((-15, -5), ((3, 4), (3.5, 4.5), (2, 3), (4.5, 5.5)), 3 * ((0, 2),)),
    "normal": ((-30, 0), ((3, 5), (3, 5), (2, 4), (4, 6)), 3 * ((0, 3),)),
    "hard": ((-50, 0), ((2, 6), (2, 6), (1, 5), (3, 7)), 3 * ((0, 4),)),
}


def hopper(physics: str = "legacy") -> Task:
    """The Hopper of D4RL and Gymnasium v5: 11 observations, 3 motors, 8 parameters.

    Rewards are those of v5: D4RL's count one more in the step in which it falls.
    """
    return walking_task(
        "hopper",
        "hopper.xml",
        physics,
        bodies=("torso", "thigh", "leg", "foot"),
        joints=("thigh_joint", "leg_joint", "foot_joint"),
        ranges=RANGES,
        positions=6,
        velocities=6,
        root=1,
        clipped=True,
        frame_skip=4,
        reward=partial(forward_reward, terminated=terminated, dt=0.008, cost=1e-3),
        terminated=terminated,
        reset_noise=partial(uniform_noise, size=12, scale=5e-3),
        groups=4,
        reference_returns=(-20.272305, 3234.3),
    )


def terminated(next_state: Batch) -> Batch:
    """Fallen: below 0.7 m, tilted by more than 0.2 rad, or any coordinate past 100."""
    height, angle = next_state[..., 1], next_state[..., 2]
    within = (abs(next_state[..., 2:]) < HEALTHY_STATE).all(-1)
    return ~(within & (height > HEALTHY_HEIGHT) & (abs(angle) < HEALTHY_ANGLE))
