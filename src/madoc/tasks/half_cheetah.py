"""HalfCheetah: two legs, six motors, never terminates."""

from functools import partial

from madoc.tasks.base import Task, never_terminated
from madoc.tasks.walking import forward_reward, uniform_and_normal_noise, walking_task

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
    return walking_task(
        "halfcheetah",
        "half_cheetah.xml",
        physics,
        bodies=("torso", "bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"),
        joints=("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"),
        ranges=RANGES,
        positions=9,
        velocities=9,
        root=1,
        clipped=False,
        frame_skip=5,
        reward=partial(forward_reward, dt=0.05, cost=0.1),
        terminated=never_terminated,
        reset_noise=partial(uniform_and_normal_noise, positions=9, velocities=9),
        groups=6,
        reference_returns=(-280.178953, 12135.0),
        total_mass=14.0,
    )
