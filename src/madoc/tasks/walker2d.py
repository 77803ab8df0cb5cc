"""Walker2d: two legs, six motors, must not fall."""

from functools import partial

from madoc.tasks.base import Batch, Task
from madoc.tasks.walking import Span, forward_reward, uniform_noise, walking_task

HEALTHY_HEIGHT = (0.8, 2.0)
"""Range of the torso's height in m; the task ends outside it."""
HEALTHY_ANGLE = 1.0
"""Largest tilt of the torso in rad; the task ends beyond it."""


def _masses(heavy: Span, light: Span) -> tuple[Span, ...]:
    """Ranges of torso, thigh, leg, foot, and of the left leg's three: torso and thighs are heavy."""
    return (heavy, heavy, light, light, heavy, light, light)


# "normal" is the paper's own (its code). "easy" and "hard" are by analogy with Hopper: masses 1 and 4 kg
# wide about the same centres, gravity as everywhere, damping of two thirds and four thirds the width.
RANGES = {
    "easy": ((-15, -5), _masses((3.5, 4.5), (2.5, 3.5)), 6 * ((0, 0.33),)),
    "normal": ((-30, 0), _masses((3, 5), (2, 4)), 6 * ((0, 0.5),)),
    "hard": ((-50, 0), _masses((2, 6), (1, 5)), 6 * ((0, 0.67),)),
}


def walker2d(physics: str = "legacy") -> Task:
    """The Walker2d of D4RL and Gymnasium v2 to v4: 17 observations, 6 motors, 14 parameters.

    Rewards are those of v5: the earlier ones count one more in the step in which it falls.
    """
    return walking_task(
        "walker2d",
        "walker2d.xml",
        physics,
        bodies=("torso", "thigh", "leg", "foot", "thigh_left", "leg_left", "foot_left"),
        joints=("thigh_joint", "leg_joint", "foot_joint", "thigh_left_joint", "leg_left_joint", "foot_left_joint"),
        ranges=RANGES,
        positions=9,
        velocities=9,
        root=1,
        clipped=True,
        frame_skip=4,
        reward=partial(forward_reward, terminated=terminated, dt=0.008, cost=1e-3),
        terminated=terminated,
        reset_noise=partial(uniform_noise, size=18, scale=5e-3),
        groups=6,
        reference_returns=(1.629008, 4592.3),
    )


def terminated(next_state: Batch) -> Batch:
    """Fallen: height outside (0.8, 2) m or tilted by more than 1 rad."""
    height, angle = next_state[..., 1], next_state[..., 2]
    low, high = HEALTHY_HEIGHT
    return ~((height > low) & (height < high) & (abs(angle) < HEALTHY_ANGLE))
