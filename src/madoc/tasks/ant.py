"""Ant: four legs, eight motors, must keep its torso up."""

from functools import partial

from madoc.tasks.base import Batch, Task
from madoc.tasks.walking import Span, forward_reward, uniform_and_normal_noise, walking_task

HEALTHY_HEIGHT = (0.2, 1.0)
"""Range of the torso's height in m; the task ends outside it."""


def _ranges(gravity: Span, torso: Span, legs: Span, damping: Span) -> tuple[Span, tuple[Span, ...], tuple[Span, ...]]:
    return gravity, (torso, *6 * (legs,)), 4 * (damping,)


# "normal" is the paper's Table 9. "easy" and "hard" are by analogy with Hopper: half and twice the width.
RANGES = {
    "easy": _ranges((-15, -5), (0.2, 0.45), (0.02, 0.07), (0, 2)),
    "normal": _ranges((-30, 0), (0, 0.5), (0, 0.1), (0, 3)),
    "hard": _ranges((-50, 0), (0, 1.0), (0, 0.2), (0, 4)),
}


def ant(physics: str = "legacy") -> Task:
    """The Ant of D4RL without its always-zero contact forces: 27 observations, 8 motors, 12 parameters.

    Its reward is Gymnasium's without the contact cost, which mujoco-py 2.x (D4RL) always had as zero.
    """
    return walking_task(
        "ant",
        "ant.xml",
        physics,
        # Bodies 1-7 of the paper's Table 9. The lower legs have no name of their own: their joints name them.
        bodies=("torso", "front_left_leg", "aux_1", "ankle_1", "front_right_leg", "aux_2", "ankle_2"),
        joints=("hip_1", "ankle_1", "hip_2", "ankle_2"),
        ranges=RANGES,
        positions=15,
        velocities=14,
        root=2,
        clipped=False,
        frame_skip=5,
        reward=partial(forward_reward, terminated=terminated, dt=0.05, cost=0.5),
        terminated=terminated,
        reset_noise=partial(uniform_and_normal_noise, positions=15, velocities=14),
        groups=6,
        reference_returns=(-325.6, 3879.7),
    )


def terminated(next_state: Batch) -> Batch:
    """Torso outside [0.2, 1] m, or a coordinate that is not finite."""
    height = next_state[..., 2]
    low, high = HEALTHY_HEIGHT
    finite = (abs(next_state) < float("inf")).all(-1)
    return ~(finite & (height >= low) & (height <= high))
